"""Maximum a posteriori fit of one hypothesis to a whole campaign.

Residuals are standardised; healthy tolerances of the unit, scatter of each stroke and the
hypothesis' own parameters are fitted together.  The normal equations have the shape of an arrow
(each stroke's scatter touches that stroke alone), so each stroke is eliminated on its own and only
the shared block is solved.  Levenberg-Marquardt, steps bounded by the physical limits.

Source: Gauss-Newton with priors, e.g. Gelman et al., Bayesian Data Analysis; Schur elimination as
in bundle adjustment (Triggs et al. 2000).
Checked by: tests/unit/sil/diagnosis/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plant.hybrid import IntegrationError
from plant.prediction import copied
from plant.setup import Setup

from .hypotheses import Candidate
from .nuisance import SIMULATED, Spread, shift
from .observations import StrokeObservation

Floats = NDArray[np.float64]

INTERNAL_SD_M = 3e-5
"""Expected scatter of one published position: timer tick and the recorder's step in time."""

FARTHEST_SD = 8.0
"""No healthy quantity is tried farther out than this: friction and flows stay positive."""

DIFFERENCE = 0.2
"""Step of the one-sided differences, in prior standard deviations of the quantity."""


@dataclass(frozen=True)
class Shared:
    """Names and positions of the shared parameters: unit tolerances, offsets, the hypothesis' own."""

    unit: tuple[str, ...]
    offsets: tuple[str, ...]
    effects: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All shared parameters in order."""
        return self.unit + self.offsets + self.effects

    @property
    def effect_slice(self) -> slice:
        """Where the hypothesis' own parameters stand."""
        begin = len(self.unit) + len(self.offsets)
        return slice(begin, begin + len(self.effects))


@dataclass
class FitResult:
    """A fitted hypothesis.

    cost: half the sum of squared standardised residuals plus priors; chi2, size: of the residuals
    alone; shared, stroke: parameters in prior standard deviations (effects in units of their typical
    size from neutral); covariance of the shared ones; values: the effects' parameters.
    """

    candidates: tuple[Candidate, ...]
    cost: float
    chi2: float
    size: int
    shared: Floats
    stroke: Floats
    covariance: Floats
    names: tuple[str, ...]
    values: tuple[dict[str, float], ...]
    iterations: int
    per_stroke: Floats
    sizes: NDArray[np.int64]
    channel_chi2: dict[str, tuple[float, int]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the hypothesis."""
        return "+".join(item.name for item in self.candidates) or "healthy"


class CampaignFit:
    """A campaign's strokes, ready to be fitted by any hypothesis."""

    def __init__(self, strokes: Sequence[StrokeObservation], spread: Spread) -> None:
        self.strokes = list(strokes)
        self.spread = spread
        gauges = sorted(
            {
                channel.name
                for stroke in self.strokes
                for channel in stroke.channels
                if channel.kind in ("pressure", "oil")
            }
        )
        positions = any(c.kind == "position" for s in self.strokes for c in s.channels)
        self.offsets = (("position_m",) if positions else ()) + tuple(gauges)
        self.unit = tuple(spread.unit)
        self.scatter = tuple(spread.stroke)

    def shared_of(self, candidates: Sequence[Candidate]) -> Shared:
        """Layout of the shared parameters under a hypothesis."""
        effects = tuple(
            f"{item.name}.{parameter.name}" for item in candidates for parameter in item.parameters
        )
        return Shared(self.unit, self.offsets, effects)

    # --- prediction ---------------------------------------------------------------------------
    def setup(
        self,
        stroke: StrokeObservation,
        amounts: dict[str, float],
        candidates: Sequence[Candidate],
        values: Sequence[dict[str, float]],
    ) -> Setup:
        """A stroke's setup with healthy amounts and effects applied."""
        setup = copied(stroke.setup)
        if stroke.internal is not None:
            setup.phase_s = stroke.internal.phase_s
        for name, amount in amounts.items():
            if amount != 0.0:
                shift(setup, name, amount)
        for candidate, own in zip(candidates, values, strict=True):
            candidate.change(setup, own)
        return setup

    def predict(self, stroke: StrokeObservation, setup: Setup) -> Floats:
        """All compared numbers of a stroke, without sensor offsets, standardised by their noise."""
        states = stroke.predictor.states(setup)
        parts = []
        for channel in stroke.channels:
            if channel.kind == "oil" and stroke.conditions.damper_model == "incompressible":
                raise NotImplementedError("oil pressure of the incompressible damper")
            parts.append(states[channel.rows, channel.state] / channel.sd)
        if stroke.internal is not None:
            parts.append(internal_prediction(stroke, setup, states[:, 0]) / INTERNAL_SD_M)
        return np.concatenate(parts)

    def measured(self, stroke: StrokeObservation) -> Floats:
        """All compared numbers as measured, standardised."""
        parts = [channel.measured / channel.sd for channel in stroke.channels]
        if stroke.internal is not None:
            parts.append(stroke.internal.values_m / INTERNAL_SD_M)
        return np.concatenate(parts)

    def offset_columns(self, stroke: StrokeObservation) -> Floats:
        """Effect of one standard deviation of each sensor offset on the standardised numbers."""
        size = stroke.size + (len(stroke.internal.values_m) if stroke.internal is not None else 0)
        columns = np.zeros((size, len(self.offsets)))
        begin = 0
        for channel in stroke.channels:
            n = len(channel.measured)
            scale = {
                "position": self.spread.position_offset_m,
                "pressure": self.spread.gauge_offset_pa,
                "oil": self.spread.oil_gauge_offset_pa,
            }[channel.kind]
            columns[begin : begin + n, self.offsets.index(channel.name)] = scale / channel.sd
            begin += n
        return columns

    def amounts(self, shared: Floats, scatter: Floats) -> dict[str, float]:
        """Healthy amounts of one stroke from unit tolerances and its own scatter."""
        total = dict.fromkeys(SIMULATED, 0.0)
        for k, name in enumerate(self.unit):
            total[name] += shared[k] * self.spread.unit[name]
        for k, name in enumerate(self.scatter):
            total[name] += scatter[k] * self.spread.stroke[name]
        return total

    def effect_values(
        self, candidates: Sequence[Candidate], scaled: Floats
    ) -> tuple[dict[str, float], ...]:
        """Effect parameters from their scaled form, kept within the physical bounds."""
        values = []
        k = 0
        for item in candidates:
            own = {}
            for parameter in item.parameters:
                raw = parameter.neutral + scaled[k] * parameter.typical
                own[parameter.name] = float(min(max(raw, parameter.low), parameter.high))
                k += 1
            values.append(own)
        return tuple(values)

    # --- one stroke ---------------------------------------------------------------------------
    def residual(
        self,
        stroke: StrokeObservation,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        layout: Shared,
    ) -> Floats:
        """Standardised residual (measured - predicted) of one stroke."""
        values = self.effect_values(candidates, shared[layout.effect_slice])
        setup = self.setup(stroke, self.amounts(shared, scatter), candidates, values)
        begin = len(self.unit)
        offsets = shared[begin : begin + len(self.offsets)]
        return (
            self.measured(stroke)
            - self.predict(stroke, setup)
            - self.offset_columns(stroke) @ offsets
        )

    def linearise(
        self,
        stroke: StrokeObservation,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        layout: Shared,
    ) -> tuple[Floats, Floats, Floats]:
        """Residual, its shared columns and its scatter columns (both of the prediction)."""
        values = self.effect_values(candidates, shared[layout.effect_slice])
        amounts = self.amounts(shared, scatter)
        base = self.predict(stroke, self.setup(stroke, amounts, candidates, values))
        columns: dict[str, Floats] = {}
        for name in SIMULATED:
            size = self.spread.stroke.get(name, self.spread.unit.get(name, 0.0))
            step = DIFFERENCE * size
            moved = dict(amounts)
            moved[name] += step
            changed = self.predict(stroke, self.setup(stroke, moved, candidates, values))
            columns[name] = (changed - base) / step
        shared_columns = np.zeros((len(base), len(layout.names)))
        for k, name in enumerate(self.unit):
            shared_columns[:, k] = columns[name] * self.spread.unit[name]
        offset = self.offset_columns(stroke)
        begin = len(self.unit)
        shared_columns[:, begin : begin + offset.shape[1]] = offset
        scaled = shared[layout.effect_slice]
        parameters = [p for item in candidates for p in item.parameters]
        for k, parameter in enumerate(parameters):
            step = 0.02
            room = (parameter.high - parameter.neutral) / parameter.typical - scaled[k]
            if room < step:
                step = -step
            moved_scaled = scaled.copy()
            moved_scaled[k] += step
            own = self.effect_values(candidates, moved_scaled)
            changed = self.predict(stroke, self.setup(stroke, amounts, candidates, own))
            shared_columns[:, layout.effect_slice.start + k] = (changed - base) / step
        scatter_columns = np.column_stack(
            [columns[name] * self.spread.stroke[name] for name in self.scatter]
        )
        offsets = shared[begin : begin + len(self.offsets)]
        return self.measured(stroke) - base - offset @ offsets, shared_columns, scatter_columns


    # --- the whole campaign -------------------------------------------------------------------
    def cost(
        self,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        layout: Shared,
        use: Sequence[int],
    ) -> float:
        """Half the squared standardised residuals plus the priors."""
        total = 0.5 * float(shared[: layout.effect_slice.start] @ shared[: layout.effect_slice.start])
        total += 0.5 * effect_prior(shared[layout.effect_slice])
        for k in use:
            try:
                r = self.residual(self.strokes[k], shared, scatter[k], candidates, layout)
            except IntegrationError:
                return np.inf
            total += 0.5 * float(r @ r) + 0.5 * float(scatter[k] @ scatter[k])
        return total

    def fit(
        self,
        candidates: Sequence[Candidate] = (),
        *,
        start: Floats | None = None,
        scatter: Floats | None = None,
        use: Sequence[int] | None = None,
        iterations: int = 12,
        freeze_shared: bool = False,
    ) -> FitResult:
        """Fit a hypothesis to the strokes in `use` (all by default).

        start: shared parameters to begin with; freeze_shared keeps them and fits the scatter of the
        strokes alone (held-out evaluation).
        """
        candidates = tuple(candidates)
        layout = self.shared_of(candidates)
        n_shared = len(layout.names)
        shared = np.zeros(n_shared) if start is None else start.copy()
        chosen = list(range(len(self.strokes))) if use is None else list(use)
        spread = (
            np.zeros((len(self.strokes), len(self.scatter))) if scatter is None else scatter.copy()
        )
        cost = self.cost(shared, spread, candidates, layout, chosen)
        damping = 1e-3
        done = 0
        for done in range(1, iterations + 1):
            normal = np.zeros((n_shared, n_shared))
            gradient = np.zeros(n_shared)
            blocks = []
            for k in chosen:
                r, a, b = self.linearise(
                    self.strokes[k], shared, spread[k], candidates, layout
                )
                hss = b.T @ b + np.eye(b.shape[1])
                hus = a.T @ b
                gs = b.T @ r - spread[k]
                inverse = np.linalg.inv(hss)
                normal += a.T @ a - hus @ inverse @ hus.T
                gradient += a.T @ r - hus @ inverse @ gs
                blocks.append((k, inverse, hus, gs))
            prior = np.ones(n_shared)
            prior[layout.effect_slice] = 1.0 / EFFECT_PRIOR**2
            normal += np.diag(prior)
            gradient -= prior * shared
            improved = False
            for _ in range(6):
                if freeze_shared:
                    step = np.zeros(n_shared)
                else:
                    step = np.linalg.solve(
                        normal + damping * np.diag(np.diag(normal)), gradient
                    )
                trial = self.bounded(shared + step, candidates, layout)
                moved = trial - shared
                trial_spread = spread.copy()
                for k, inverse, hus, gs in blocks:
                    moved_to = spread[k] + inverse @ (gs - hus.T @ moved)
                    trial_spread[k] = np.clip(moved_to, -FARTHEST_SD, FARTHEST_SD)
                trial_cost = self.cost(trial, trial_spread, candidates, layout, chosen)
                if trial_cost < cost:
                    improved = True
                    break
                damping = max(damping * 8.0, 1e-3)
            if not improved:
                break
            gain = cost - trial_cost
            shared, spread, cost = trial, trial_spread, trial_cost
            damping = max(damping * 0.2, 1e-7)
            if gain < 0.05 + 1e-5 * cost:
                break
        return self.finish(shared, spread, candidates, layout, chosen, cost, done)

    def bounded(
        self, shared: Floats, candidates: Sequence[Candidate], layout: Shared
    ) -> Floats:
        """Shared parameters with the effects' own within their bounds and physical sign."""
        out = shared.copy()
        out[: layout.effect_slice.start] = np.clip(
            out[: layout.effect_slice.start], -FARTHEST_SD, FARTHEST_SD
        )
        k = layout.effect_slice.start
        for item in candidates:
            for parameter in item.parameters:
                low = (parameter.low - parameter.neutral) / parameter.typical
                high = (parameter.high - parameter.neutral) / parameter.typical
                out[k] = min(max(out[k], low), high)
                k += 1
        return out

    def finish(
        self,
        shared: Floats,
        spread: Floats,
        candidates: tuple[Candidate, ...],
        layout: Shared,
        chosen: Sequence[int],
        cost: float,
        done: int,
    ) -> FitResult:
        """Residuals by stroke and channel, and the covariance of the shared parameters."""
        normal = np.zeros((len(layout.names), len(layout.names)))
        per_stroke = np.zeros(len(chosen))
        sizes = np.zeros(len(chosen), dtype=np.int64)
        channels: dict[str, list[float]] = {}
        for place, k in enumerate(chosen):
            stroke = self.strokes[k]
            r, a, b = self.linearise(stroke, shared, spread[k], candidates, layout)
            inverse = np.linalg.inv(b.T @ b + np.eye(b.shape[1]))
            hus = a.T @ b
            normal += a.T @ a - hus @ inverse @ hus.T
            per_stroke[place] = float(r @ r) + float(spread[k] @ spread[k])
            sizes[place] = len(r)
            begin = 0
            for channel in stroke.channels:
                n = len(channel.measured)
                part = r[begin : begin + n]
                item = channels.setdefault(channel.name, [0.0, 0.0])
                item[0] += float(part @ part)
                item[1] += n
                begin += n
            if stroke.internal is not None:
                part = r[begin:]
                item = channels.setdefault("position_internal_m", [0.0, 0.0])
                item[0] += float(part @ part)
                item[1] += len(part)
        prior = np.ones(len(layout.names))
        prior[layout.effect_slice] = 1.0 / EFFECT_PRIOR**2
        covariance = np.linalg.pinv(normal + np.diag(prior))
        return FitResult(
            candidates=candidates,
            cost=cost,
            chi2=float(np.sum(per_stroke)),
            size=int(np.sum(sizes)),
            shared=shared,
            stroke=spread,
            covariance=covariance,
            names=layout.names,
            values=self.effect_values(candidates, shared[layout.effect_slice]),
            iterations=done,
            per_stroke=per_stroke,
            sizes=sizes,
            channel_chi2={name: (v[0], int(v[1])) for name, v in channels.items()},
        )


EFFECT_PRIOR = 10.0
"""Width of the prior of an effect's parameter, in typical sizes: weak."""


def effect_prior(scaled: Floats) -> float:
    """Squared distance of the effects' parameters from neutral under their weak prior."""
    return float(scaled @ scaled) / EFFECT_PRIOR**2


def internal_prediction(stroke: StrokeObservation, setup: Setup, position: Floats) -> Floats:
    """The published positions of a stroke under a setup, at the instants of publication observed.

    The instants of publication are data; when the pulses were measured follows from them, the
    latency and the clock of the setup.
    """
    internal = stroke.internal
    if internal is None:
        raise ValueError("the stroke has no internal position")
    chain = setup.chain
    base = stroke.setup.chain
    period = chain.period_s
    later = chain.latency_s - base.latency_s + setup.clock_offset_s
    duration = base.calibration.duration_s(internal.values_m, base.measured_temperature_k)
    half = 0.5 * float(stroke.time_s[1] - stroke.time_s[0])
    place = (internal.published_s - half - base.latency_s - duration - internal.phase_s) / period
    pulses = np.rint(place).astype(int)
    first = int(np.floor(-internal.phase_s / period)) - 2
    count = int(pulses[-1]) - first + 1
    ticks = internal.phase_s + period * (first + np.arange(count)) - later
    measured_s = ticks + 0.5 * chain.sensor.t_mid_s
    true_m = np.interp(measured_s, stroke.time_s, position)
    _published, values = chain.published(ticks, true_m, quantise=False)
    index = np.clip(pulses - first, 0, count - 1)
    return setup.internal_gain * np.asarray(values)[index]
