"""What was measured, made ready for comparison: instants, channels, expected noise.

The record is thinned where nothing happens; neighbouring samples of a resting potentiometer carry one piece
of information. The control unit's position is one value a publication, whose instants say where the
record is within the sensor's period.
Checked by: tests/unit/sil/inference/campaign/test_observations.py
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.batch.prediction import Predictor
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel.layout import FIXED, FixedState, LengthState
from plant.parameters import ParameterSet
from plant.parts.damper import steady_oil_pressure
from plant.systems.setup import make_setup
from sil.campaign.campaign import CampaignStroke, Floats, Record

INTERNAL_SD_M = 3e-5
"""Expected scatter of one published position: timer tick and a recorder's step of 0.1 ms."""


@dataclass(frozen=True)
class InternalSamples:
    """Published positions [m], when they appeared on the recorder's clock [s], mid of the step, and their expected scatter."""

    published_s: Floats
    values_m: Floats
    sd_m: Floats


def internal_samples(time_s: Floats, values: Floats) -> InternalSamples | None:
    """Return the publications in values [n] in m at time_s [n]; None without motion, or recorded slower than every 5 ms."""
    step_s = float(time_s[1] - time_s[0])
    edges = np.flatnonzero(np.abs(np.diff(values)) > 1e-9) + 1
    if step_s > 0.005 or len(edges) < 4:
        return None
    slope_m_s = np.abs(np.gradient(values[edges], time_s[edges]))
    # beyond the usual recorder's step of 0.1 ms, which the expected scatter holds
    late_s = (max(0.0, step_s**2 - 1e-4**2) / 12.0) ** 0.5
    sd_m = np.hypot(INTERNAL_SD_M, slope_m_s * late_s)
    return InternalSamples(time_s[edges] - 0.5 * step_s, values[edges], sd_m)


def internal_prediction(
    internal: InternalSamples,
    time_s: Floats,
    position_m: Floats,
    setup: Setup,
    rounded: bool = True,
) -> Floats:
    """Return the published positions of a stroke under a setup, at the publications observed [m].

    position_m: the true one at time_s; rounded: as the timer counts pulses at rest, without: smooth.
    """
    chain = setup.chain
    period = chain.period_s
    unit_s = internal.published_s * (1.0 - setup.clock_drift) - setup.clock_offset_s
    about_s = unit_s - chain.latency_s - 0.5 * chain.sensor.t_mid_s
    pulse_s = chain.sensor.duration_s(
        np.interp(about_s, time_s, position_m), chain.coil_temperature_k
    )
    begun = unit_s - chain.latency_s - pulse_s
    turn = 2.0 * np.pi / period
    phase = float(np.angle(np.mean(np.exp(1j * turn * begun)))) / turn % period
    pulses = np.rint((begun - phase) / period).astype(int)
    first = min(int(np.floor(-phase / period)) - 1, int(pulses[0]))
    count = int(pulses[-1]) - first + 1
    ticks = phase + period * (first + np.arange(count))
    true_m = np.interp(ticks + 0.5 * chain.sensor.t_mid_s, time_s, position_m)
    warm = chain.sensor.duration_s(true_m, chain.coil_temperature_k)
    if rounded:
        # less than 0.1 um from pulse to pulse
        resting = np.abs(np.diff(true_m, prepend=true_m[0])) < 1e-7
        warm = np.where(resting, chain.sensor.ticks(warm) * chain.sensor.tick_s, warm)
    observed = chain.calibration.position_m(warm, chain.measured_temperature_k)
    response = _impulse_response(chain.filter_order, chain.cutoff_hz, period, count)
    values = observed[0] + np.convolve(observed - observed[0], response)[:count]
    return setup.reported_m(values[np.minimum(np.maximum(pulses - first, 0), count - 1)])


@lru_cache(maxsize=64)
def _impulse_response(order: int, cutoff_hz: float, period_s: float, count: int) -> Floats:
    """Response of a chain's filter to one unit value, `count` periods long."""
    impulse = np.zeros(count + 1)
    impulse[1] = 1.0
    if order:
        from plant.devices.sensors import low_passed

        impulse = low_passed(impulse, order, cutoff_hz, 1.0 / period_s)
    return np.asarray(impulse[1:])


FINE_S = 2e-4


@dataclass(frozen=True)
class Noise:
    """Noise of a channel: standard deviation, its relative uncertainty if it was estimated, step of a wire or converter."""

    sd: float
    step: float
    uncertainty: float = 0.0


@dataclass(frozen=True)
class ObservedChannel:
    """One measured quantity of a stroke: where it is in the record and in the prediction."""

    name: str
    kind: str  # "position", "pressure", "oil", "internal"
    state: int
    measured: Floats
    sd: Floats
    rows: NDArray[np.int64]  # rows of the predictor's instants
    noise: Noise
    floor: float  # expected sum of squares of standardised residuals


@dataclass
class StrokeObservation:
    """One stroke: base setup, instants, channels."""

    entry: CampaignStroke
    setup: Setup
    predictor: Predictor
    time_s: Floats
    channels: tuple[ObservedChannel, ...]
    internal: InternalSamples | None

    @property
    def conditions(self) -> StrokeConditions:
        """The stroke's stated conditions."""
        return self.entry.conditions

    def offset_of(self, channel: ObservedChannel) -> str:
        """Return the name of a channel's offset, which another campaign of the unit does not share."""
        session = self.entry.session
        return f"{channel.name} of {session}" if session else channel.name

    @property
    def size(self) -> int:
        """How many numbers are compared."""
        return sum(len(channel.measured) for channel in self.channels)

    @property
    def total(self) -> int:
        """How many numbers are compared, the control unit's positions included."""
        return self.size + (0 if self.internal is None else len(self.internal.values_m))

    def predicted(self, channel: ObservedChannel, states: Floats, setup: Setup) -> Floats:
        """Return what a channel shows of the states [instants, states], [n] in SI units, by the damper's model in force."""
        if channel.kind != "oil" or self.conditions.damper_model != "incompressible":
            return np.asarray(states[channel.rows, channel.state])
        out = np.zeros(len(states))
        position = np.ascontiguousarray(states[:, 0])
        steady_oil_pressure(position, np.ascontiguousarray(states[:, 1]), setup.p.array, out)
        return out[channel.rows]


def observe(
    entry: CampaignStroke,
    record: Record,
    parameters: ParameterSet,
    clipped: Collection[str] = (),
    dead: Collection[str] = (),
    *,
    shift_s: float = 0.0,
    noise: Mapping[str, Noise] | None = None,
) -> StrokeObservation:
    """Thin one stroke's record and set the stroke up as its conditions say.

    clipped: columns whose largest value is no measurement; dead: columns to leave out; shift_s: by
    which the record runs late; noise: of each column, the parameters' own by default. What a calibration
    left unexplained adds to it, once for all samples within its correlation time.
    """
    conditions = entry.conditions
    setup = make_setup(parameters, conditions)
    nominal = nominal_noise(parameters)
    time_s = record.time_s - record.time_s[0] - shift_s
    step_s = float(np.median(np.diff(time_s)))
    rows = _thinned(time_s, step_s, conditions, setup)
    instants = np.rint(time_s[rows] * NS_PER_S).astype(np.int64)
    internal, grid = None, instants
    if "position_internal_m" in record:
        internal = internal_samples(time_s, record["position_internal_m"])
    if internal is not None and step_s > FINE_S:
        # the control unit samples between the instants of a slow recorder
        fine_s = np.arange(0.0, time_s[-1], FINE_S)
        thinned = _thinned(fine_s, FINE_S, conditions, setup)
        grid = np.union1d(instants, np.rint(fine_s[thinned] * NS_PER_S).astype(np.int64))
    at = np.searchsorted(grid, instants)
    fixed = conditions.system == FIXED
    channels: list[ObservedChannel] = []

    def add(column: str, state: int) -> None:
        kind = kind_of(column)
        measured, use = record[column][rows], np.full(len(rows), True)
        if column in clipped and kind == "pressure":
            use = measured < record[column].max() - 1e-9
        channel_noise = (noise or {}).get(column, nominal[kind])
        weights, floor = np.ones(len(rows)), 1.0
        if kind == "position":
            # a resting wiper stays on one wire: its samples are one observation, not hundreds
            weights = np.maximum(1.0, _run_lengths(measured, channel_noise.step) / 4.0)
            usual = channel_noise is nominal[kind] and step_s <= FINE_S
            # mean squares on clean simulated campaigns
            floor = 0.385**2 if usual else 1.035 * float(np.mean(1.0 / weights))
        sd: Floats = channel_noise.sd * np.sqrt(weights[use])
        size = float(floor * np.count_nonzero(use))
        if f"discrepancy.{column}" in parameters:
            left = parameters.value(f"discrepancy.{column}")
            apart_s = np.gradient(time_s[rows])[use]
            alike = np.maximum(1.0, parameters.value(f"discrepancy_time.{column}") / apart_s)
            variance = sd**2 + left**2 * alike
            size = float(np.sum((floor * sd**2 + left**2) / variance))
            sd = np.sqrt(variance)
        channels.append(
            ObservedChannel(column, kind, state, measured[use], sd, at[use], channel_noise, size)
        )

    if "position_m" in record:
        add("position_m", 0)
    first = FixedState.p_1 if fixed else LengthState.p_b
    for k, name in enumerate(conditions.chambers):
        column = f"pressure_{name}_pa"
        if column in record and column not in dead:
            add(column, first + k)
    if "pressure_oil2_pa" in record and conditions.load == "damper":
        add("pressure_oil2_pa", FixedState.p_oil if fixed else LengthState.p_oil)
    return StrokeObservation(
        entry, setup, Predictor(grid), grid / NS_PER_S, tuple(channels), internal
    )


def kind_of(column: str) -> str:
    """Return the kind of a channel, as in `ObservedChannel.kind`."""
    if column.startswith("position"):
        return "position"
    return "oil" if column == "pressure_oil2_pa" else "pressure"


def nominal_noise(parameters: ParameterSet) -> dict[str, Noise]:
    """Return the noise of each kind of channel by the parameters, its converter's step included."""
    value = parameters.value
    levels = 2 ** value("gauge.adc_bits")
    rows = {
        "position": (value("potentiometer.noise_sd"), value("potentiometer.resolution")),
        "pressure": (value("gauge.noise_sd_air"), value("gauge.range_air") / levels),
        "oil": (value("gauge.noise_sd_oil"), value("gauge.range_oil") / levels),
    }
    return {k: Noise(float(np.hypot(sd, step / 12**0.5)), step) for k, (sd, step) in rows.items()}


def _thinned(
    time_s: Floats, step_s: float, conditions: StrokeConditions, setup: Setup
) -> NDArray[np.int64]:
    """Rows of the record to compare: 0.2 ms apart while things happen, 1 ms otherwise, 20 ms at rest."""
    fine, coarse, rest = (max(1, round(apart / step_s)) for apart in (FINE_S, 1e-3, 0.02))
    keep = np.zeros(len(time_s), dtype=bool)
    keep[::rest] = True
    for when, _valve, duty in (*conditions.commands, (0.0, "", 0.0)):
        opens = duty >= setup.timing.duty_open
        begin = when + 0.004 if opens else when + 0.02
        end = when + (0.11 if opens else 0.06)
        keep[::coarse] |= ((time_s >= when) & (time_s <= when + 0.5))[::coarse]
        if when:
            keep[fine - 1 :: fine] |= ((time_s >= begin) & (time_s <= end))[fine - 1 :: fine]
    keep[-1] = True
    return np.flatnonzero(keep & (time_s >= 0.0))


def _run_lengths(values: Floats, step: float) -> Floats:
    """Return the length of the run of neighbours within a step of wire or converter that each sample belongs to."""
    edges = np.flatnonzero(np.abs(np.diff(values)) >= 1.4 * step) + 1
    out = np.ones(len(values))
    for stretch, lengths in zip(np.split(values, edges), np.split(out, edges), strict=True):
        # only long level stretches count as rest: the wiper's level must not drift
        if len(stretch) > 8:
            level = np.abs(stretch - np.median(stretch)) < 2.4 * step
            lengths[level] = np.count_nonzero(level)
    return out
