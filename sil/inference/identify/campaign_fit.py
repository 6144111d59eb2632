"""Parameters of the model fitted to whole records of a campaign, healthy scatter included.

The same whole-campaign fit as the diagnosis': tolerances of the unit, gauge offsets and each
stroke's own scatter are fitted with the parameters, under their priors. Derivatives are taken along
the strokes' own steps instead of by differences: `plant.batch.prediction.Predictor.derivatives` moves
every quantity by a millionth in one call, events included; the fit gets its Jacobian for a few
strokes' worth, without the noise of free runs.
Checked by: tests/unit/sil/inference/identify/test_identify.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from plant.batch.tangents import MOVE
from plant.effects import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, CampaignStroke, Floats
from sil.files.quantity import counted
from sil.inference.campaign.model import CampaignModel, Moved
from sil.inference.campaign.observations import observe
from sil.inference.candidate import Candidate
from sil.inference.evidence import misfit
from sil.inference.fit import Fitter, Show, no_progress
from sil.inference.identify.estimate import Estimate
from sil.inference.spread import Spread

DELAYS = {"rise": "rise_ns", "fall": "fall_ns"}
DELAY_STEP_S = 20e-9


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
            h = DELAY_STEP_S if name in DELAYS else float(np.copysign(MOVE, step))
            setups.append(moved(name, h))
            if name in DELAYS:
                before, after = (getattr(s.timing, DELAYS[name]) for s in (setup, setups[-1]))
                h = 1e-9 * (after - before)
            sizes.append(h)
        states, found = self.strokes[k].predictor.derivatives(setup, setups, sizes)
        base = self.numbers_of(k, setup, states, False)
        columns: dict[str, Floats] = {}
        for (name, step), other, h, rates in zip(steps.items(), setups, sizes, found, strict=True):
            if rates is None or h == 0.0:
                columns[name] = self.difference(k, base, partial(moved, name), step, central)
            else:
                columns[name] = (self.numbers_of(k, other, states + h * rates, False) - base) / h
        return base, columns


def fit_factors(
    campaign: Campaign,
    strokes: Sequence[CampaignStroke],
    parameters: ParameterSet,
    indices: Mapping[str, int],
    known: Sequence[str] = (),
    progress: Show = no_progress,
) -> tuple[tuple[Estimate, ...], float]:
    """Fit factors on packed parameters; return estimates, and the residual over its expected noise.

    indices: parameter path -> its index in the packed array; known: healthy unit tolerances that
    the parameters themselves express (frozen at zero).
    """
    from scipy.stats import t as student

    observed = [
        replace(observe(entry, campaign.record(entry), parameters), internal=None)
        for entry in strokes
    ]
    model = TangentModel(observed, Spread.of(parameters))
    source = f"whole-record fit of {counted(len(strokes), 'stroke')} with their scatter"

    def change(setup: Setup, values: dict[str, float]) -> None:
        for path, index in indices.items():
            setup.p[index] *= values[path]

    own = tuple(EffectParameter(path, "-", 1.0, 0.05, 20.0, 0.1) for path in indices)
    effect = Effect("identified", "identified", "force", source, own, change)
    candidate = Candidate(effect, "", own, ())
    layout = model.layout((candidate,))
    frozen = [layout.names.index(name) for name in known]
    start = np.zeros(len(layout.names))
    found = Fitter(model, progress).fit((candidate,), start=start, freeze=frozen, iterations=20)
    free = [k for k in range(len(layout.names)) if k not in frozen]
    covariance = np.linalg.pinv(found.normal[np.ix_(free, free)])
    reduced = max(1.0, found.chi2 / found.size)
    # the prior of the scatter counts about as much as two strokes
    quantile = float(student.ppf(0.975, len(strokes) + 1))
    estimates = []
    for k, path in enumerate(indices):
        row = free.index(layout.effect_slice.start + k)
        base = parameters.value(path)
        centre = base * found.values[0][path]
        half = quantile * float(np.sqrt(covariance[row, row] * reduced)) * 0.1 * base
        estimates.append(Estimate(path, centre, centre - half, centre + half, source))
    return tuple(estimates), misfit(model, found).rms
