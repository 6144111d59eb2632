"""A campaign's strokes as functions of what may be wrong: predictions, residuals, derivatives.

All numbers are standardised by the expected noise of their channel.
Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from plant.batch.prediction import MOVE
from plant.effects import EffectParameter
from plant.effects.setup import Setup
from plant.effects.tolerances import shift
from plant.errors import IntegrationError
from sil.campaign.campaign import Floats
from sil.inference.campaign.observations import (
    INTERNAL_SD_M,
    ObservedChannel,
    StrokeObservation,
    internal_prediction,
)
from sil.inference.campaign.split import Stratum, stratum
from sil.inference.candidate import Candidate, is_scale, log_size, scaled_of
from sil.inference.problem import Block, ChannelPart, Problem
from sil.inference.spread import Spread

DIFFERENCE = 0.05
"""Step of the one-sided differences, in prior standard deviations of the quantity."""
JUMP = 1e-4
"""Share of its channel's largest by which no number follows a millionth of a quantity, or 20 ns: jumps have no slope."""


Moved = Callable[[str, float], Setup]


class CampaignModel(Problem):
    """The strokes of a campaign and the healthy spread: what any hypothesis is compared with.

    measured: by stroke, all compared numbers [n] as measured, standardised; offset_columns: by stroke,
    what one standard deviation of each sensor's offset adds to them [n, offsets].
    """

    def __init__(self, strokes: Sequence[StrokeObservation], spread: Spread) -> None:
        self.strokes = list(strokes)
        self.spread = spread
        kinds = {stroke.offset_of(c): c.kind for stroke in self.strokes for c in stroke.channels}
        self.offsets = tuple(sorted(kinds, key=lambda name: (kinds[name] != "position", name)))
        self.unit = tuple(spread.unit)
        # what a stroke must be simulated again for; a cylinder has further quantities
        flows = ("flow_in", "flow_out", "volume_a", "volume_b")
        self.simulated = tuple(dict.fromkeys((*spread.stroke, *flows, *spread.unit)))
        self.scatter = tuple(spread.stroke)
        self.measured = [_standardised(stroke) for stroke in self.strokes]
        self.offset_columns = [self._offsets_of(stroke) for stroke in self.strokes]
        # where each stroke was simulated last: a step that is accepted is linearised there
        self._last: dict[int, tuple[tuple[Any, ...], Setup, Floats]] = {}
        self._residual: dict[int, Floats] = {}
        # the healthy setup that each stroke had last: causes and their values are tried on the same one
        self._healthy: dict[int, tuple[dict[str, float], Setup]] = {}

    # --- prediction ---------------------------------------------------------------------------
    def setup(
        self,
        k: int,
        amounts: dict[str, float],
        candidates: Sequence[Candidate],
        values: Sequence[Mapping[str, float]],
    ) -> Setup:
        """Stroke k's setup with healthy amounts and effects applied."""
        last = self._healthy.get(k)
        if last is None or last[0] != amounts:
            healthy = self.strokes[k].setup.copy()
            for name, amount in amounts.items():
                if amount != 0.0:
                    shift(healthy, name, amount)
            last = self._healthy[k] = dict(amounts), healthy
        setup = last[1].copy()
        for candidate, parameters in zip(candidates, values, strict=True):
            candidate.change(setup, parameters)
        return setup

    def predict(self, k: int, setup: Setup, rounded: bool = False) -> Floats:
        """Return the compared numbers [n] of stroke k, without sensor offsets; rounded: as the timer does at rest.

        Raises IntegrationError where the motion cannot be continued.
        """
        return self.numbers_of(k, setup, self.strokes[k].predictor.states(setup), rounded)

    def numbers_of(self, k: int, setup: Setup, states: Floats, rounded: bool) -> Floats:
        """Return the compared numbers [n] of stroke k in the states [instants, states], SI units."""
        stroke = self.strokes[k]
        out = np.empty(stroke.total)
        for channel, part in channel_parts(stroke, out):
            np.divide(stroke.predicted(channel, states, setup), channel.sd, out=part)
        if stroke.internal is not None:
            reported = internal_prediction(
                stroke.internal, stroke.time_s, states[:, 0], setup, rounded
            )
            np.divide(reported, stroke.internal.sd_m, out=out[stroke.size :])
        return out

    def measure(self, k: int, numbers: Floats) -> None:
        """Take other compared numbers [n], standardised, as those measured of stroke k."""
        self.measured[k] = numbers
        self._residual.pop(k, None)

    def _offsets_of(self, stroke: StrokeObservation) -> Floats:
        columns = np.zeros((stroke.total, len(self.offsets)))
        for channel, part in channel_parts(stroke, columns):
            index = self.offsets.index(stroke.offset_of(channel))
            part[:, index] = self.spread.offset[channel.kind] / channel.sd
        return columns

    def amounts(self, shared: Floats, scatter: Floats) -> dict[str, float]:
        """Return the healthy amounts of a stroke from the unit's tolerances [shared] and its scatter."""
        total = dict.fromkeys(self.simulated, 0.0)
        unit = self.spread.root @ shared[: len(self.unit)]
        for name, amount in zip(self.unit, unit.tolist(), strict=True):
            total[name] += amount
        for k, name in enumerate(self.scatter):
            total[name] += scatter[k] * self.spread.stroke[name]
        return total

    def effect_step(self, tolerance: str, parameter: EffectParameter) -> float:
        """Step of an effect parameter's difference, in typical sizes; that of the tolerance that does the same, if any.

        At stops and breakaways the prediction has kinks, where unlike steps would seem distinguishable.
        """
        if not tolerance:
            return 0.005  # small against the curvature, large against rounding
        step = DIFFERENCE * self.spread.size(tolerance)
        return float(step / (log_size(parameter) if is_scale(parameter) else parameter.typical))

    def name_of(self, k: int) -> str:
        """Return the file of stroke k."""
        return self.strokes[k].entry.file

    def stratum(self, k: int) -> Stratum:
        """Return the conditions that repeated strokes share."""
        return stratum(self.strokes[k])

    def offsets_in(self, k: int) -> set[str]:
        """Return the names of the offsets of stroke k's sensors."""
        return {self.strokes[k].offset_of(channel) for channel in self.strokes[k].channels}

    def parts(self, k: int, residual: Floats) -> Iterator[ChannelPart]:
        """Yield the parts of a residual [n], no unit, by channel, the control unit's position last.

        Positions are standardised conservatively (a resting wiper says one thing, not hundreds), so their
        floors are lower: by the weights of the samples, and by what clean simulated campaigns show.
        """
        stroke = self.strokes[k]
        # between clean campaigns, in addition to the spread that counting gives
        spreads = {"position": 0.03, "pressure": 0.004, "oil": 0.008}
        for channel, part in channel_parts(stroke, residual):
            spread = float(np.hypot(spreads[channel.kind], channel.noise.uncertainty))
            yield ChannelPart(channel.name, part, channel.floor, spread)
        if stroke.internal is not None:
            # rms of residuals: 0.17 with the usual recorder, 0.7 of what a slow one adds
            usual = (INTERNAL_SD_M / stroke.internal.sd_m) ** 2
            slow = float(np.sum(1.0 - usual)) * 0.7**2
            floor = float(np.sum(usual)) * 0.17**2 + slow
            spread = 0.05 + 0.5 * slow / floor
            yield ChannelPart("position_internal_m", residual[stroke.size :], floor, spread)

    def changed(
        self,
        k: int,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        values: Sequence[Mapping[str, float]],
    ) -> Floats:
        """Return the numbers [n] of stroke k at values of the candidates, without sensor offsets."""
        return self.predict(k, self.setup(k, self.amounts(shared, scatter), candidates, values))

    # --- one stroke ---------------------------------------------------------------------------
    def residual(
        self, k: int, shared: Floats, scatter: Floats, candidates: Sequence[Candidate]
    ) -> Floats:
        """Return the standardised residual (measured - predicted) [n] of stroke k."""
        setup, states = self.here(k, shared, scatter, candidates)
        if k not in self._residual:
            offsets = shared[len(self.unit) : len(self.unit) + len(self.offsets)]
            predicted = self.numbers_of(k, setup, states, True)
            self._residual[k] = self.measured[k] - predicted - self.offset_columns[k] @ offsets
        return self._residual[k]

    def here(
        self, k: int, shared: Floats, scatter: Floats, candidates: Sequence[Candidate]
    ) -> tuple[Setup, Floats]:
        """Return setup and states [instants, states] of stroke k in SI units; the last are stored."""
        spot = (shared.tobytes(), scatter.tobytes(), tuple(item.name for item in candidates))
        last = self._last.get(k)
        if last is None or last[0] != spot:
            values = self.effect_values(candidates, shared[len(self.unit) + len(self.offsets) :])
            setup = self.setup(k, self.amounts(shared, scatter), candidates, values)
            last = (spot, setup, self.strokes[k].predictor.states(setup))
            self._last[k] = last
            self._residual.pop(k, None)
        return last[1], last[2]

    def linearise(
        self,
        k: int,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        central: bool = False,
        own_only: bool = False,
        reuse: Block | None = None,
        frozen: Collection[int] = (),
    ) -> Block:
        """Return stroke k linearised at shared [shared] and its own scatter, as the base class."""
        layout = self.layout(candidates)
        healthy, tolerances = layout.healthy, len(self.unit)
        scaled = shared[healthy:]
        amounts = self.amounts(shared, scatter)
        residual = self.residual(k, shared, scatter, candidates)
        here = self.here(k, shared, scatter, candidates)

        def moved(name: str, h: float) -> Setup:
            near, trial = dict(amounts), scaled.copy()
            if name in near:
                near[name] += h
            else:
                trial[layout.effects.index(name)] += h
            return self.setup(k, near, candidates, self.effect_values(candidates, trial))

        steps: dict[str, float] = {}
        if not own_only and reuse is None:
            free = [j for j in range(tolerances) if j not in frozen]
            by_name = zip(self.unit, self.spread.root, strict=True)
            needed = {*self.scatter, *(name for name, row in by_name if row[free].any())}
            steps = {n: DIFFERENCE * self.spread.size(n) for n in self.simulated if n in needed}
        delays: dict[str, tuple[str, float]] = {}
        effect_parameters = [(item.effect, p) for item in candidates for p in item.parameters]
        own = enumerate(zip(layout.effects, effect_parameters, scaled, strict=True), healthy)
        for j, (name, (effect, parameter), value) in own:
            if j in frozen:
                continue
            step = self.effect_step(effect.tolerance, parameter)
            if scaled_of(parameter, parameter.high) - value < step:
                step = -step
            if effect.switching and not own_only:
                at_s = [_delay_ns(s, effect.switching) / 1e9 for s in (here[0], moved(name, step))]
                by_step = (at_s[1] - at_s[0]) / step
                delays[name] = effect.switching, by_step
            else:
                steps[name] = step
        base, columns = self.derivatives(k, here, moved, steps, central)
        by_shared = np.zeros((len(base), len(layout.names)))
        by_scatter = np.zeros((len(base), len(self.scatter)))
        if reuse is not None:
            by_shared[:, :tolerances] = reuse.shared[:, :tolerances]
            by_scatter = reuse.scatter
        elif not own_only:
            rows = [j for j, name in enumerate(self.unit) if name in columns]
            by_unit = np.array([columns[self.unit[j]] for j in rows])
            by_shared[:, free] = by_unit.T @ self.spread.root[np.ix_(rows, free)]
            for j, name in enumerate(self.scatter):
                by_scatter[:, j] = columns[name] * self.spread.stroke[name]
        by_shared[:, tolerances:healthy] = self.offset_columns[k]
        for name, (instant, by_step) in delays.items():
            if reuse is None:
                by_second = columns[instant]
            else:
                by_second = by_scatter[:, self.scatter.index(instant)] / self.spread.stroke[instant]
            columns[name] = by_second * by_step
        for j, name in enumerate(layout.effects, healthy):
            if name in columns:
                by_shared[:, j] = columns[name]
        return Block(residual, by_shared, by_scatter, base)

    def derivatives(
        self,
        k: int,
        here: tuple[Setup, Floats],
        moved: Moved,
        steps: Mapping[str, float],
        central: bool,
    ) -> tuple[Floats, dict[str, Floats]]:
        """Return the smooth prediction [n] of stroke k and its derivatives [n] by the names in `steps`.

        here: setup and states; moved(name, h): the setup with one quantity moved; steps: for differences.
        """
        base = self.numbers_of(k, *here, rounded=False)
        return base, {
            name: self.difference(k, base, partial(moved, name), step, central)
            for name, step in steps.items()
        }

    def difference(
        self, k: int, base: Floats, moved: Callable[[float], Setup], step: float, central: bool
    ) -> Floats:
        """Difference quotient [n], one-sided or with a smaller step where needed; raises IntegrationError if none can be simulated."""
        if central:
            # wider, against the rounding of the integration: the error is of second order here
            wide = 4.0 * step
            with suppress(IntegrationError):
                difference = self.predict(k, moved(wide)) - self.predict(k, moved(-wide))
                return difference / (2.0 * wide)
        for h in (step, -step, 0.1 * step, -0.1 * step):
            with suppress(IntegrationError):
                return (self.predict(k, moved(h)) - base) / h
        raise IntegrationError("no direction in which the motion can be continued")


def _standardised(stroke: StrokeObservation) -> Floats:
    parts = [channel.measured / channel.sd for channel in stroke.channels]
    if stroke.internal is not None:
        parts.append(stroke.internal.values_m / stroke.internal.sd_m)
    return np.concatenate(parts) if parts else np.zeros(0)


def channel_parts(
    stroke: StrokeObservation, residual: Floats
) -> Iterator[tuple[ObservedChannel, Floats]]:
    """Yield the channels of a stroke with their part [n] of its numbers; the control unit's position, after them, is left out."""
    begin = 0
    for channel in stroke.channels:
        end = begin + len(channel.measured)
        yield channel, residual[begin:end]
        begin = end


def _delay_ns(setup: Setup, instant: str) -> int:
    return setup.timing.rise_ns if instant == "rise" else setup.timing.fall_ns


class TangentModel(CampaignModel):
    """The campaign's model for strokes compared by external records alone, with derivatives along their own steps.

    `Predictor.derivatives` moves every quantity by a millionth or 20 ns in one call, events included.
    """

    has_tangents = True

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
            is_delay = name in ("rise", "fall")
            is_time = is_delay or name == "gauge_lag"
            h = 20e-9 if is_time else float(np.copysign(MOVE, step))
            setups.append(moved(name, h))
            if is_delay:
                h = 1e-9 * (_delay_ns(setups[-1], name) - _delay_ns(setup, name))
            sizes.append(h)
        predictor = self.strokes[k].predictor
        states, all_rates = predictor.derivatives(
            setup, setups, sizes, tolerance=predictor.tolerance
        )
        base = self.numbers_of(k, setup, states, False)
        columns: dict[str, Floats] = {}
        for (name, step), other, h, rates in zip(
            steps.items(), setups, sizes, all_rates, strict=True
        ):
            if rates is None or h == 0.0:
                columns[name] = self.difference(k, base, partial(moved, name), step, central)
            else:
                change = self.numbers_of(k, other, states + h * rates, False) - base
                parts = (channel_parts(self.strokes[k], numbers) for numbers in (change, base))
                jumps = any(
                    np.abs(by).max() > JUMP * np.abs(level).max()
                    for (_, by), (_, level) in zip(*parts, strict=True)
                )
                columns[name] = np.zeros_like(base) if jumps else change / h
        return base, columns


def model_of(strokes: Sequence[StrokeObservation], spread: Spread) -> CampaignModel:
    """Return the model of a campaign: tangents for a cylinder, at whose stops differences would feign precision."""
    is_cylinder = all(stroke.setup.p.air_kappa > 0.0 for stroke in strokes)
    return (TangentModel if is_cylinder else CampaignModel)(strokes, spread)
