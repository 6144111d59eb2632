"""The campaign's model with derivatives along the strokes' own steps instead of by differences.

`plant.batch.prediction.Predictor.derivatives` moves every quantity by a millionth in one call, events
included; a fit gets its Jacobian for a few strokes' worth, without the noise of free runs.
Checked by: tests/unit/sil/inference/identify/test_identify.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from plant.batch.tangents import MOVE
from plant.effects.setup import Setup
from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel, Moved
from sil.inference.campaign.observations import StrokeObservation
from sil.inference.spread import Spread

DELAY_ARGUMENTS = {"rise": "rise_ns", "fall": "fall_ns"}


class TangentModel(CampaignModel):
    """The campaign's model for strokes that are compared by external records alone."""

    def derivatives(
        self,
        k: int,
        here: tuple[Setup, Floats],
        moved: Moved,
        steps: Mapping[str, float],
        central: bool,
    ) -> tuple[Floats, dict[str, Floats]]:
        """As the base class's [n]; by differences only where the events do not move along."""
        setup = here[0]
        sizes, setups = [], []
        for name, step in steps.items():
            h = 20e-9 if name in DELAY_ARGUMENTS else float(np.copysign(MOVE, step))
            setups.append(moved(name, h))
            if name in DELAY_ARGUMENTS:
                before, after = (
                    getattr(s.timing, DELAY_ARGUMENTS[name]) for s in (setup, setups[-1])
                )
                h = 1e-9 * (after - before)
            sizes.append(h)
        predictor = self.strokes[k].predictor
        if setup.p.air_kappa == 0.0:
            states, found = predictor.derivatives(setup, setups, sizes)
        else:
            # chambers that are full make a cylinder stiff, and steps at the limit of stability magnify a
            # neighbour's distance, never the opposite: the least of several sequences of steps is right
            others = [
                predictor.derivatives(setup, setups, sizes, tolerance=t) for t in (1e-8, 3e-9, 1e-9)
            ]
            states = others[0][0]
            found = [
                _least(rates) for rates in zip(*(rates for _states, rates in others), strict=True)
            ]
        base = self.numbers_of(k, setup, states, False)
        columns: dict[str, Floats] = {}
        for (name, step), other, h, rates in zip(steps.items(), setups, sizes, found, strict=True):
            if rates is None or h == 0.0:
                columns[name] = self.difference(k, base, partial(moved, name), step, central)
            else:
                columns[name] = (self.numbers_of(k, other, states + h * rates, False) - base) / h
        return base, columns


def _least(rates: Sequence[Floats | None]) -> Floats | None:
    """Return the derivative [n, states] in which each state, in its own unit, changes least in all; None without any."""
    some = [one for one in rates if one is not None]
    if not some:
        return None
    least = np.argmin([np.sum(one**2, axis=0) for one in some], axis=0)
    return np.stack([some[j][:, column] for column, j in enumerate(least)], axis=1)


def model_of(strokes: Sequence[StrokeObservation], spread: Spread) -> CampaignModel:
    """Return the model of a campaign: along the strokes' own steps for a cylinder.

    At its stops, differences would feign precision.
    """
    is_cylinder = all(stroke.setup.p.air_kappa > 0.0 for stroke in strokes)
    return (TangentModel if is_cylinder else CampaignModel)(strokes, spread)
