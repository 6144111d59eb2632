"""Is this campaign what it claims to be: units, scales, channels, clocks, saturation.

What cannot be compared is refused in one line (InputError); what is odd but usable is a finding.
Checked by: tests/unit/sil/diagnosis/test_checks.py
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from can_dbc.errors import InputError
from plant.batch.prediction import copied
from plant.errors import IntegrationError
from plant.parameters import ParameterSet
from sil.campaign.campaign import CampaignStroke, Record
from sil.fitting.fit import FitResult
from sil.fitting.model import CampaignModel, channel_parts
from sil.fitting.observations import StrokeObservation

LEAST_DURATION_S = 0.02
FEWEST_SAMPLES = 50
SATURATED_SHARE = 0.005
SHIFT_S = 0.002
SATURATED = "saturated"


Signals = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Measured and predicted values [n], and their instants [n] in s, by channel."""


@dataclass(frozen=True)
class Finding:
    """Something odd about a file that the diagnosis could live with."""

    file: str
    channel: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}: {self.channel}: {self.text}"


def check_record(entry: CampaignStroke, record: Record, parameters: ParameterSet) -> list[Finding]:
    """Refuse a stroke that cannot be compared; report what is odd about it.

    Raises InputError naming file and column: too short, uneven sampling, wrong unit or scale,
    a channel that does not move while the stroke moves.
    """
    path = record.path
    time_s = record.time_s
    if len(time_s) < FEWEST_SAMPLES or time_s[-1] - time_s[0] < LEAST_DURATION_S:
        raise InputError(
            f"{path}: {len(time_s)} samples over {time_s[-1] - time_s[0]:.4g} s; "
            f"expected a whole stroke"
        )
    steps = np.diff(time_s)
    if steps.max() > 3.0 * np.median(steps):
        line = int(np.argmax(steps)) + 3
        raise InputError(
            f"{path}: line {line}: time_s jumps by {steps.max():.4g} s; "
            f"expected steps of {np.median(steps):.4g} s"
        )
    last = max((when for when, _valve, _duty in entry.conditions.commands), default=0.0)
    first = min((when for when, _valve, _duty in entry.conditions.commands), default=0.0)
    if time_s[-1] - time_s[0] < first + 0.03:
        raise InputError(
            f"{path}: ends at {time_s[-1]:.4g} s; the stroke's first command is at {first:.4g} s"
        )
    findings = []
    if time_s[-1] - time_s[0] < last:
        findings.append(
            Finding(entry.file, "time_s", f"ends before the last command at {last:.4g} s")
        )
    findings += check_position(entry, record, parameters)
    findings += check_pressures(entry, record, parameters)
    return findings


def check_position(
    entry: CampaignStroke, record: Record, parameters: ParameterSet
) -> list[Finding]:
    """Return the potentiometer: metres, within the rig's travel, and moving.

    Raises InputError naming file and column.
    """
    if "position_m" not in record:
        return []
    path, values = record.path, record["position_m"]
    section = "fixed" if entry.conditions.kind == "fixed" else "length"
    stroke = parameters.value(f"{section}.stroke")
    largest = float(np.abs(values).max())
    if largest > 2.0 * stroke:
        raise InputError(
            f"{path}: position_m: reaches {largest:.4g}; expected metres, at most "
            f"{1.2 * stroke:.4g} m{unit_hint(largest / stroke, LENGTHS)}"
        )
    moved = float(np.ptp(values))
    if moved < 0.02 * stroke and len(np.unique(values)) < 3:
        charging = any(
            column.startswith("pressure_") and float(np.ptp(record[column])) > 5e4
            for column in record.columns
        )
        if charging:
            raise InputError(
                f"{path}: position_m: does not move from {values[0]:.5g} m while pressures move; "
                "expected the stroke"
            )
    if moved < 0.05 * stroke and moved > 0.0 and "position_internal_m" in record:
        internal = float(np.ptp(record["position_internal_m"]))
        if internal > 0.5 * stroke:
            raise InputError(
                f"{path}: position_m: moves {moved:.3g} while position_internal_m moves "
                f"{internal:.3g} m; expected metres"
            )
    return []


def check_pressures(
    entry: CampaignStroke, record: Record, parameters: ParameterSet
) -> list[Finding]:
    """Return the gauges: absolute pascals within their range, not stuck, not clipped.

    Raises InputError naming file and column.
    """
    findings = []
    atmosphere = entry.conditions.atmosphere_pa
    supply = entry.conditions.supply_pressure_pa
    for name in record.columns:
        if not (name.startswith("pressure_") and name.endswith("_pa")):
            continue
        values = record[name]
        path = record.path
        oil = name == "pressure_oil2_pa"
        top = parameters.value("gauge.range_oil" if oil else "gauge.range_air")
        high, low = float(values.max()), float(values.min())
        if high < 0.02 * atmosphere:
            raise InputError(
                f"{path}: {name}: at most {high:.4g}; expected pascals, absolute "
                f"(about {atmosphere:.4g} at rest){unit_hint(high / supply, PRESSURES)}"
            )
        if not oil and high > 2.0 * max(supply, atmosphere):
            raise InputError(
                f"{path}: {name}: reaches {high:.4g} Pa; expected at most the supply's "
                f"{supply:.4g} Pa{unit_hint(high / supply, PRESSURES)}"
            )
        if low < 0.5 * atmosphere and not oil:
            raise InputError(
                f"{path}: {name}: falls to {low:.4g} Pa; expected absolute pressure, about "
                f"{atmosphere:.4g} Pa at rest (gauge pressure, or another unit?)"
            )
        if float(np.ptp(values)) == 0.0:
            raise InputError(
                f"{path}: {name}: constant at {values[0]:.6g} Pa; expected at least its noise "
                "(leave a dead channel out)"
            )
        clipped = float(np.mean(values >= high - 1e-9))
        if (
            clipped > SATURATED_SHARE
            and high > 1.5 * atmosphere
            and (high < 0.995 * supply or high >= 0.999 * top)
        ):
            longest = longest_run(values >= high - 1e-9)
            if longest >= 20:
                findings.append(
                    Finding(
                        entry.file,
                        name,
                        f"{SATURATED} at {high:.6g} Pa ({clipped:.1%}); left out there",
                    )
                )
    return findings


def longest_run(flags: np.ndarray) -> int:
    """Return length of the longest run of true values.

    flags: [n].
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


LENGTHS = ((1e3, "millimetres"), (1e2, "centimetres"), (39.37, "inches"), (1e6, "micrometres"))
PRESSURES = (
    (1e-5, "bar"),
    (1e-3, "kilopascals"),
    (1e-6, "megapascals"),
    (1.45e-4, "psi"),
    (1e3, "millipascals, or a scale too large by 1000"),
)


def unit_hint(ratio: float, units: tuple[tuple[float, str], ...]) -> str:
    """Which unit a value off by this factor was probably written in."""
    nearest = min(units, key=lambda item: abs(np.log(ratio / item[0])) if ratio > 0.0 else 1e9)
    if ratio > 0.0 and abs(np.log(ratio / nearest[0])) < 1.1:
        return f" (in {nearest[1]}?)"
    return ""


SWAPPED, SHIFTED = "swapped", "against its commands"


def check_signals(strokes: Sequence[StrokeObservation]) -> tuple[list[Finding], dict[int, float]]:
    """Return swapped gauges and shifted records, found by the unfitted model.

    Returns the findings and the shift [s] of each stroke that has one.  A late valve is no shift:
    what comes after its closing would not fit then; nor is a plunger that crosses slowly.
    """
    findings = []
    shifts: dict[int, float] = {}
    slow = 0
    for k, stroke in enumerate(strokes):
        try:
            states = stroke.predictor.states(stroke.setup)
        except IntegrationError:
            continue
        pressures = {
            c.name: (c.measured, states[c.rows, c.state], stroke.time_s[c.rows])
            for c in stroke.channels
            if c.kind == "pressure"
        }
        findings += [
            Finding(stroke.entry.file, pair, f"channels are {SWAPPED}; left out")
            for pair in swapped(pressures, 1e9, 0.1)
        ]
        shift = time_shift(pressures)
        motion = {
            c.name: (c.measured, states[c.rows, c.state], stroke.time_s[c.rows])
            for c in stroke.channels
            if c.kind == "position"
        }
        # late gauges are no shifted record: the position would be late too
        moves_too = not motion or bool(
            np.diff(shift_costs(motion, np.array([0.0, shift])))[0] < 0.0
        )
        if abs(shift) >= SHIFT_S and moves_too:
            shifts[k] = shift
            slow += creeps(stroke, pressures, shift)
    if 2 * slow >= len(shifts):
        return findings, {}
    findings += [
        Finding(
            strokes[k].entry.file,
            "time_s",
            f"the record runs {1e3 * shift:+.1f} ms {SHIFTED}; taken off",
        )
        for k, shift in shifts.items()
    ]
    return findings, shifts


def creeps(
    stroke: StrokeObservation,
    pressures: Signals,
    shift: float,
) -> bool:
    """Return whether plungers that cross slowly explain a stroke better than a shift of its record.

    Both ways slow, a plunger is half its travel late at opening and at closing alike.

    pressures: measured and predicted [n] in Pa and instants [n] in s, by channel.
    """
    if shift <= 0.0:
        return False
    setup = copied(stroke.setup)
    setup.creep_s = 2.0 * shift
    try:
        states = stroke.predictor.states(setup)
    except IntegrationError:
        return False
    slow = {
        c.name: (c.measured, states[c.rows, c.state], stroke.time_s[c.rows])
        for c in stroke.channels
        if c.name in pressures
    }
    at = np.array([shift])
    return bool(shift_costs(slow, np.zeros(1))[0] < shift_costs(pressures, at)[0])


def check_strokes(model: CampaignModel, fit: FitResult) -> list[Finding]:
    """Return what the fit itself shows of single strokes: swapped channels, a shifted time base."""
    findings = []
    for k, stroke in enumerate(model.strokes):
        block = fit.blocks.get(k)
        if block is None:
            continue
        pressures = {
            channel.name: (
                channel.measured,
                channel.measured - part * channel.sd,
                stroke.time_s[channel.rows],
            )
            for channel, part in channel_parts(stroke, block.residual)
            if channel.kind == "pressure"
        }
        findings += [
            Finding(stroke.entry.file, pair, "channels are swapped")
            for pair in swapped(pressures, 1e8, 0.25)
        ]
        shift = time_shift(pressures)
        if abs(shift) >= SHIFT_S:
            findings.append(
                Finding(
                    stroke.entry.file,
                    "time_s",
                    f"the record runs {1e3 * shift:+.1f} ms against its commands",
                )
            )
    return findings


def swapped(pressures: Signals, least: float, share: float) -> list[str]:
    """Return pairs of gauges whose misfit is at least this [Pa^2] and less than a share if exchanged."""
    found = []
    for one, two in itertools.combinations(sorted(pressures), 2):
        (a, b, _t), (c, d, _s) = pressures[one], pressures[two]
        if len(a) != len(c):
            continue
        straight = misfit_of((a, b)) + misfit_of((c, d))
        if straight > least and misfit_of((a, d)) + misfit_of((c, b)) < share * straight:
            found.append(f"{one}, {two}")
    return found


def misfit_of(pair: tuple[np.ndarray, np.ndarray]) -> float:
    """Return mean squared difference of two signals [Pa^2]."""
    return float(np.mean((pair[0] - pair[1]) ** 2))


def time_shift(pressures: Signals) -> float:
    """Return shift of the measured pressures against the predicted ones that explains them best [s].

    pressures: measured, predicted, instants.

    Zero unless a shift removes nine tenths of the misfit.
    """
    if not pressures:
        return 0.0
    coarse = np.arange(-0.03, 0.0301, 0.0005)
    costs = shift_costs(pressures, coarse)
    here = costs[len(coarse) // 2]
    best = float(coarse[int(np.argmin(costs))])
    if not (here > 1e8 and costs.min() < 0.1 * here):
        return 0.0
    fine = best + np.arange(-0.0005, 0.00051, 0.0001)
    return float(fine[int(np.argmin(shift_costs(pressures, fine)))])


def shift_costs(pressures: Signals, shifts: np.ndarray) -> np.ndarray:
    """Return sum of the mean squared misfits of all pressures at each shift [Pa^2]."""
    costs = np.zeros(len(shifts))
    for measured, predicted, time_s in pressures.values():
        for j, shift in enumerate(shifts):
            moved = np.interp(time_s - shift, time_s, predicted)
            costs[j] += float(np.mean((measured - moved) ** 2))
    return costs
