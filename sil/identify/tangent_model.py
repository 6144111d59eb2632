"""A campaign's strokes linearised by derivatives along their own steps instead of by differences.

`plant.batch.prediction.Predictor.derivatives` moves every quantity by a millionth in one call, events
included; the fit gets its Jacobian for a few strokes' worth, without the noise of free runs.
Checked by: tests/unit/sil/identify/test_identify.py
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plant.batch.tangents import MOVE
from plant.effects.setup import Setup
from sil.fitting.hypotheses import Candidate, scaled_of
from sil.fitting.model import DIFFERENCE, EFFECT_STEP, Block, CampaignModel, Floats, difference
from sil.fitting.nuisance import SIMULATED

DELAYS = {"rise": "rise_ns", "fall": "fall_ns"}
DELAY_STEP_S = 20e-9


class TangentModel(CampaignModel):
    """The campaign's model for strokes that are compared by external records alone."""

    def linearise(  # noqa: C901 - one case for each kind of parameter
        self,
        k: int,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        central: bool = False,
        own_only: bool = False,
        reuse: Block | None = None,
    ) -> Block:
        """As the base class's; differences only where the events do not move along.

        shared: [shared], scatter: [scatter], in prior standard deviations.
        """
        layout = self.layout(candidates)
        healthy = layout.healthy
        scaled = shared[healthy:]
        amounts = self.amounts(shared, scatter)

        def made(name: str, h: float) -> Setup:
            """Return the stroke with one quantity moved: a healthy one, or "0", "1", ... of the effects."""
            moved, trial = dict(amounts), scaled.copy()
            if name in moved:
                moved[name] += h
            elif name:
                trial[int(name)] += h
            return self.setup(k, moved, candidates, self.effect_values(candidates, trial))

        parameters = [p for item in candidates for p in item.parameters]
        names = [] if own_only or reuse is not None else list(SIMULATED)
        names += [str(j) for j in range(len(parameters))]
        base_setup = made("", 0.0)
        setups, steps = [], []
        for name in names:
            h = DELAY_STEP_S if name in DELAYS else MOVE
            if name not in amounts:
                parameter = parameters[int(name)]
                h = (
                    -MOVE
                    if scaled_of(parameter, parameter.high) - scaled[int(name)] < MOVE
                    else MOVE
                )
            setup = made(name, h)
            if name in DELAYS:
                clock = DELAYS[name]
                h = 1e-9 * (getattr(setup.timing, clock) - getattr(base_setup.timing, clock))
            setups.append(setup)
            steps.append(h)
        states, found = self.strokes[k].predictor.derivatives(base_setup, setups, steps)
        base = self.numbers_of(k, base_setup, states, False)
        columns: dict[str, Floats] = {}
        for name, setup, h, rates in zip(names, setups, steps, found, strict=True):
            if rates is not None and h != 0.0:
                columns[name] = (self.numbers_of(k, setup, states + h * rates, False) - base) / h
                continue

            def changed(h: float, name: str = name) -> Floats:
                return self.predict(k, made(name, h))

            spread = self.spread.stroke.get(name, self.spread.unit.get(name, 0.0))
            step = DIFFERENCE * spread if name in amounts else EFFECT_STEP
            columns[name] = difference(changed, base, step, central)
        by_shared = np.zeros((len(base), len(layout.names)))
        by_scatter = np.zeros((len(base), len(self.scatter)))
        for j, name in enumerate(self.unit):
            if name in columns:
                by_shared[:, j] = columns[name] * self.spread.unit[name]
        for j, name in enumerate(self.scatter):
            if name in columns:
                by_scatter[:, j] = columns[name] * self.spread.stroke[name]
        if reuse is not None:
            by_shared[:, : len(self.unit)] = reuse.shared[:, : len(self.unit)]
            by_scatter = reuse.scatter
        by_shared[:, len(self.unit) : healthy] = self._offset_columns[k]
        for j in range(len(parameters)):
            by_shared[:, healthy + j] = columns[str(j)]
        return Block(self.residual(k, shared, scatter, candidates), by_shared, by_scatter, base)
