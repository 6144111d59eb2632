"""What was measured, made ready for comparison: instants, channels, expected noise.

The record is thinned where nothing happens: full resolution while something moves, coarse while
chambers fill; neighbouring samples of a resting potentiometer carry one piece of information.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.batch.prediction import Predictor
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.equations.damper_pressure import steady_oil_pressure
from plant.kernel.layout import FIXED, FixedState, LengthState
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.campaign.campaign import CampaignStroke, Floats, Record
from sil.fitting.internal import InternalSamples, internal_samples

NS = 1_000_000_000


@dataclass(frozen=True)
class Channel:
    """One measured quantity of a stroke: where it is in the record and in the prediction."""

    name: str
    kind: str  # "position", "pressure", "oil", "internal"
    state: int
    measured: Floats
    sd: Floats
    rows: NDArray[np.int64]  # rows of the predictor's instants


@dataclass
class StrokeObservation:
    """One stroke: base setup, instants, channels."""

    entry: CampaignStroke
    setup: Setup
    predictor: Predictor
    time_s: Floats
    channels: tuple[Channel, ...]
    internal: InternalSamples | None

    @property
    def conditions(self) -> StrokeConditions:
        """The stroke's stated conditions."""
        return self.entry.conditions

    @property
    def size(self) -> int:
        """How many numbers are compared."""
        return sum(len(channel.measured) for channel in self.channels)

    @property
    def total(self) -> int:
        """How many numbers are compared, the control unit's positions included."""
        return self.size + (0 if self.internal is None else len(self.internal.values_m))

    def oil_pressure_pa(self, states: Floats, setup: Setup) -> Floats:
        """Absolute pressure of the damper's chamber two by the model in force [Pa]."""
        fixed = self.conditions.system == FIXED
        if self.conditions.damper_model != "incompressible":
            return np.asarray(states[:, FixedState.p_oil if fixed else LengthState.p_oil])
        out = np.zeros(len(states))
        position = np.ascontiguousarray(states[:, 0])
        steady_oil_pressure(position, np.ascontiguousarray(states[:, 1]), setup.p.array, out)
        return out


def observe(
    entry: CampaignStroke,
    record: Record,
    parameters: ParameterSet,
    clipped: Collection[str] = (),
    dead: Collection[str] = (),
) -> StrokeObservation:
    """Thin one stroke's record and set the stroke up as its conditions say.

    clipped: columns whose largest value is no measurement; dead: columns to leave out.
    """
    conditions = entry.conditions
    setup = make_setup(parameters, conditions)
    time_s = record.time_s - record.time_s[0]
    rows = _thinned(time_s, conditions, setup)
    internal = None
    if "position_internal_m" in record:
        internal = internal_samples(time_s, record["position_internal_m"])
    fixed = conditions.system == FIXED
    channels: list[Channel] = []

    def add(column: str, kind: str, state: int, sd: float | Floats) -> None:
        measured, use = record[column][rows], np.arange(len(rows))
        if column in clipped and kind == "pressure":
            use = use[measured < record[column].max() - 1e-9]
        sds = np.full(len(use), sd)
        channels.append(Channel(column, kind, state, measured[use], sds, use))

    value = parameters.value
    if "position_m" in record:
        step = value("potentiometer.resolution") / 12**0.5
        pot_sd = float(np.hypot(value("potentiometer.noise_sd"), step))
        # a resting wiper stays on one wire: its samples are one observation, not hundreds
        runs = _run_lengths(record["position_m"][rows])
        add("position_m", "position", 0, pot_sd * np.sqrt(np.maximum(1.0, runs / 4.0)))
    first = FixedState.p_1 if fixed else LengthState.p_b
    for k, name in enumerate(conditions.chambers):
        column = f"pressure_{name}_pa"
        if column in record and column not in dead:
            add(column, "pressure", first + k, air_noise_pa(parameters))
    if "pressure_oil2_pa" in record and conditions.load == "damper":
        state = FixedState.p_oil if fixed else LengthState.p_oil
        add("pressure_oil2_pa", "oil", state, _gauge_noise_pa(parameters, "oil"))
    predictor = Predictor(np.rint(time_s[rows] * NS).astype(np.int64))
    return StrokeObservation(entry, setup, predictor, time_s[rows], tuple(channels), internal)


def air_noise_pa(parameters: ParameterSet) -> float:
    """Return the standard deviation of an air gauge's noise, its converter's step included [Pa]."""
    return _gauge_noise_pa(parameters, "air")


def _gauge_noise_pa(parameters: ParameterSet, medium: str) -> float:
    value = parameters.value
    step = value(f"gauge.range_{medium}") / 2 ** value("gauge.adc_bits") / 12**0.5
    return float(np.hypot(value(f"gauge.noise_sd_{medium}"), step))


def _thinned(time_s: Floats, conditions: StrokeConditions, setup: Setup) -> NDArray[np.int64]:
    """Rows of the record to compare: every second while things happen, every tenth otherwise."""
    keep = np.zeros(len(time_s), dtype=bool)
    keep[::10] = True
    for when, _valve, duty in conditions.commands:
        opens = duty >= setup.timing.duty_open
        begin = when + 0.004 if opens else when + 0.02
        end = when + (0.11 if opens else 0.06)
        dense = (time_s >= begin) & (time_s <= end)
        keep[1::2] |= dense[1::2]
    keep[-1] = True
    return np.flatnonzero(keep)


def _run_lengths(values: Floats) -> Floats:
    """Return the length of the run of near-equal neighbours that each sample belongs to."""
    close = np.abs(np.diff(values)) < 0.7e-4
    same = np.concatenate([[False], close])
    start = np.flatnonzero(~same)
    lengths = np.diff(np.concatenate([start, [len(values)]]))
    # only long level stretches count as rest: the wiper's level must not drift
    out = np.ones(len(values))
    for begin, length in zip(start, lengths, strict=True):
        stretch = values[begin : begin + length]
        if length > 8:
            level = np.abs(stretch - np.median(stretch)) < 1.2e-4
            out[begin : begin + length][level] = np.count_nonzero(level)
    return out
