"""Strokes read and checked: units, scales, channels, clocks, saturation.

What cannot be compared is refused in one line (InputError); what is odd but usable is a finding.
Checked by: tests/unit/sil/inference/campaign/test_checks.py
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from can_dbc.errors import InputError
from plant.errors import IntegrationError
from plant.parameters import ParameterSet
from plant.systems.stroke import wrong_start
from sil.campaign.campaign import Campaign, CampaignStroke, Floats, Record, misspelt_columns
from sil.campaign.units import COLUMN_UNITS
from sil.files.quantity import counted, quantity, unit_of
from sil.inference.campaign.model import CampaignModel, channel_parts
from sil.inference.campaign.noise import estimated_noise
from sil.inference.campaign.observations import StrokeObservation, kind_of, nominal_noise, observe
from sil.inference.fit import FitResult
from sil.recording.runs import longest_run

SHIFT_S = 0.002
"""Least shift of a record against its commands that is reported."""
SATURATED, SWAPPED = "saturated", "swapped"

Signals = dict[str, tuple[Floats, Floats, Floats]]
"""Measured and predicted values [n], and their instants [n] in s, by channel."""


@dataclass(frozen=True)
class Finding:
    """Something odd about a file that the diagnosis could live with."""

    file: str
    channel: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}: {self.channel}: {self.text}"


def observed(
    campaign: Campaign, parameters: ParameterSet
) -> tuple[list[StrokeObservation], list[Finding]]:
    """Return the strokes of a campaign, checked, and what is odd about them but usable.

    Raises InputError for a stroke that cannot be compared, and if none has a position or a pressure.
    """
    findings: list[Finding] = []
    records = [campaign.record(entry) for entry in campaign.strokes]
    named = zip(campaign.strokes, (record.columns for record in records), strict=True)
    findings += [Finding(*what) for what in misspelt_columns(named)]
    for dialect in sorted({record.dialect for record in records} - {""}):
        files = [r.path.name for r in records if r.dialect == dialect]
        more = f" and {len(files) - 1} more" if files[1:] else ""
        findings.append(Finding(files[0] + more, "read as", dialect))
    clipped: list[set[str]] = []
    for entry, record in zip(campaign.strokes, records, strict=True):
        odd = check_record(entry, record, parameters)
        findings += odd
        clipped.append({item.channel for item in odd if item.text.startswith(SATURATED)})
    strokes = list(map(observe, campaign.strokes, records, itertools.repeat(parameters), clipped))
    odd, shifts = check_signals(strokes, campaign)
    findings += odd
    nominal = nominal_noise(parameters)
    noise = estimated_noise(strokes, records, nominal)
    for k, entry in enumerate(campaign.strokes):
        dead = {
            name
            for item in odd
            if item.file == entry.file and SWAPPED in item.text
            for name in item.channel.split(", ")
        }
        if dead or k in shifts or noise:
            shift_s = shifts.get(k, 0.0)
            left_out = clipped[k], dead
            strokes[k] = observe(
                entry, records[k], parameters, *left_out, shift_s=shift_s, noise=noise
            )
    if not any(stroke.channels or stroke.internal for stroke in strokes):
        raise InputError(f"{campaign.folder}: no position and no pressure in any stroke")
    for name, measured_noise in noise.items():
        times = f"{measured_noise.sd / nominal[kind_of(name)].sd:.2g} times what is usual"
        text = f"noise of {quantity(measured_noise.sd, unit_of(name), 2)}, {times}"
        findings.append(Finding(campaign.name, name, f"{text}: estimated from the records"))
    return strokes, findings


# --- single records ---------------------------------------------------------------------------
def check_record(entry: CampaignStroke, record: Record, parameters: ParameterSet) -> list[Finding]:
    """Refuse a stroke that cannot be compared; report what is odd about it.

    Raises InputError naming file and column: too short, uneven sampling, wrong unit or scale,
    a channel that does not move while the stroke moves.
    """
    path, time_s = record.path, record.time_s
    start_offset_m, stroke_m = entry.conditions.start_offset_m, parameters.value("fixed.stroke")
    if entry.conditions.kind == "fixed" and (why := wrong_start(start_offset_m, stroke_m)):
        raise InputError(f"{path}: {why}")
    duration = time_s[-1] - time_s[0]
    if len(time_s) < 16 or duration < 0.02:
        what = f"{len(time_s)} samples over {duration:.4g} s"
        raise InputError(f"{path}: {what}; expected a whole stroke")
    steps = np.diff(time_s)
    usual = np.median(steps)
    gaps = steps[steps > 3.0 * usual] - usual
    if gaps.sum() > 0.02 * duration:
        where = f"{path}: line {int(np.argmax(steps)) + 3}"
        expected = f"expected steps of {usual:.4g} s"
        raise InputError(f"{where}: time_s jumps by {steps.max():.4g} s; {expected}")
    commands = [when for when, _valve, _duty in entry.conditions.commands] or [0.0]
    if duration < min(commands) + 0.03:
        first = f"the stroke's first command is at {min(commands):.4g} s"
        raise InputError(f"{path}: ends at {time_s[-1]:.4g} s; {first}")
    findings: list[Finding] = []
    if len(gaps):
        text = f"{counted(len(gaps), 'gap')}, {gaps.sum():.3g} s in all; nothing is assumed in them"
        findings.append(Finding(entry.file, "time_s", text))
    if duration < max(commands):
        text = f"ends before the last command at {max(commands):.4g} s"
        findings.append(Finding(entry.file, "time_s", text))
    if "position_m" in record:
        _check_position(entry, record, parameters)
    for name in record.columns:
        if name.startswith("pressure_") and name.endswith("_pa"):
            findings += _check_pressure(entry, record, name, parameters)
    return findings


def _check_position(entry: CampaignStroke, record: Record, parameters: ParameterSet) -> None:
    """Refuse a potentiometer that is not in metres, beyond the rig's travel or does not move."""
    where, values = f"{record.path}: position_m", record["position_m"]
    section = "fixed" if entry.conditions.kind == "fixed" else "length"
    stroke = parameters.value(f"{section}.stroke")
    largest, moved = float(np.abs(values).max()), float(np.ptp(values))
    spans = {name: float(np.ptp(column)) for name, column in record.columns.items()}
    if largest > 2.0 * stroke:
        hint = _unit_hint(largest / stroke, "position_m")
        most = f"at most {1.2 * stroke:.4g} m{hint}"
        raise InputError(f"{where}: reaches {largest:.4g}; expected metres, {most}")
    pressures_move = any(n.startswith("pressure_") and span > 5e4 for n, span in spans.items())
    if moved < 0.02 * stroke and len(np.unique(values)) < 3 and pressures_move:
        raise InputError(
            f"{where}: does not move from {values[0]:.5g} m while pressures move; expected the stroke"
        )
    internal = spans.get("position_internal_m", 0.0)
    if 0.0 < moved < 0.05 * stroke and internal > 0.5 * stroke:
        raise InputError(
            f"{where}: moves {moved:.3g} while position_internal_m moves {internal:.3g} m; "
            "expected metres"
        )


def _check_pressure(
    entry: CampaignStroke, record: Record, name: str, parameters: ParameterSet
) -> list[Finding]:
    """Refuse a gauge that is not in absolute pascals within its range, or stuck; report clipping."""
    atmosphere, supply = entry.conditions.atmosphere_pa, entry.conditions.supply_pressure_pa
    values, oil = record[name], name == "pressure_oil2_pa"
    high, low = float(values.max()), float(values.min())
    hint = _unit_hint(high / supply, "pressure_pa")
    flaws = {
        f"at most {high:.4g}; expected pascals, absolute (about {atmosphere:.4g} at rest){hint}": (
            high < 0.02 * atmosphere
        ),
        f"reaches {high:.4g} Pa; expected at most the supply's {supply:.4g} Pa{hint}": (
            not oil and high > 2.0 * max(supply, atmosphere)
        ),
        f"falls to {low:.4g} Pa; expected absolute pressure, about {atmosphere:.4g} Pa at rest "
        "(gauge pressure, or another unit?)": low < 0.5 * atmosphere and not oil,
        f"constant at {values[0]:.6g} Pa; expected at least its noise (leave a dead channel out)": (
            high == low
        ),
    }
    for text, is_so in flaws.items():
        if is_so:
            raise InputError(f"{record.path}: {name}: {text}")
    top = parameters.value("gauge.range_oil" if oil else "gauge.range_air")
    clipped = values >= high - 1e-9
    share = float(np.mean(clipped))
    beyond = high > 1.5 * atmosphere and (high < 0.995 * supply or high >= 0.999 * top)
    if share > 0.005 and beyond and longest_run(clipped) >= 20:
        text = f"{SATURATED} at {high:.6g} Pa ({share:.1%}); left out there"
        return [Finding(entry.file, name, text)]
    return []


def _unit_hint(ratio: float, column: str) -> str:
    """Return which unit a value off by this factor was probably written in; column: a key of COLUMN_UNITS."""
    if ratio <= 0.0:
        return ""
    apart = {unit: abs(np.log(ratio * scale)) for unit, scale in COLUMN_UNITS[column].items()}
    unit = min(apart, key=lambda name: apart[name])
    return f" (in {unit}?)" if apart[unit] < 1.1 and COLUMN_UNITS[column][unit] != 1.0 else ""


# --- measured against predicted ---------------------------------------------------------------
def check_signals(
    strokes: Sequence[StrokeObservation], campaign: Campaign
) -> tuple[list[Finding], dict[int, float]]:
    """Return swapped gauges and the shift [s] of each record that has one unlike most others, by the unfitted model.

    What shifts share is left to the hypotheses, a late valve among them. Raises InputError for a position
    of reversed sign.
    """
    findings: list[Finding] = []
    shifts: dict[int, float] = {}
    for k, stroke in enumerate(strokes):
        try:
            states = stroke.predictor.states(stroke.setup)
        except IntegrationError:
            continue
        pressures, motion = (_signals(stroke, states, kind) for kind in ("pressure", "position"))
        _refuse_reversed(stroke, states, motion, campaign)
        findings += _swapped(stroke, pressures, 1e9, 0.1, "; left out")
        shift = time_shift(pressures)
        # late gauges are no shifted record: the position would be late too
        moves_too = not motion or np.diff(_shift_costs(motion, np.array([0.0, shift])))[0] < 0.0
        shifts[k] = shift if moves_too else 0.0
    closing = {k: any(duty == 0.0 for *_, duty in strokes[k].conditions.commands) for k in shifts}
    to_take_off = {}
    for k, shift in shifts.items():
        alike = [s for j, s in shifts.items() if j != k and closing[j] == closing[k]]
        if abs(shift) >= SHIFT_S and alike and np.median(np.abs(alike)) < SHIFT_S:
            to_take_off[k] = shift
            findings.append(_shifted(strokes[k], shift, "; taken off"))
    return findings, to_take_off


def _refuse_reversed(
    stroke: StrokeObservation, states: Floats, motion: Signals, campaign: Campaign
) -> None:
    """Refuse a position that moves opposite to the commanded motion."""
    signals = {name: (measured, predicted) for name, (measured, predicted, _t) in motion.items()}
    if stroke.internal is not None:
        about_s = stroke.internal.published_s - 2.0 * stroke.setup.chain.period_s
        there = np.interp(about_s, stroke.time_s, states[:, 0])
        signals["position_internal_m"] = stroke.internal.values_m, there
    for name, (measured, predicted) in signals.items():
        moves = np.ptp(predicted) > 1e-3 and np.ptp(measured) > 0.3 * np.ptp(predicted)
        if moves and np.corrcoef(measured, predicted)[0, 1] < -0.8:
            raise InputError(
                f"{campaign.folder / stroke.entry.file}: {name}: moves opposite to the commanded "
                "motion: its sign is reversed (state scale = -1 in [columns]), or kind or commands "
                "are those of another stroke"
            )


def check_strokes(model: CampaignModel, fit: FitResult) -> list[Finding]:
    """Return what the fit itself shows of single strokes: swapped channels, a shifted time base."""
    findings: list[Finding] = []
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        pressures = {
            c.name: (c.measured, c.measured - part * c.sd, stroke.time_s[c.rows])
            for c, part in channel_parts(stroke, block.residual)
            if c.kind == "pressure"
        }
        findings += _swapped(stroke, pressures, 1e8, 0.25)
        shift = time_shift(pressures)
        if abs(shift) >= SHIFT_S:
            findings.append(_shifted(stroke, shift))
    return findings


def _signals(stroke: StrokeObservation, states: Floats, kind: str) -> Signals:
    return {
        c.name: (c.measured, states[c.rows, c.state], stroke.time_s[c.rows])
        for c in stroke.channels
        if c.kind == kind
    }


def _shifted(stroke: StrokeObservation, shift: float, then: str = "") -> Finding:
    text = f"the record runs {1e3 * shift:+.1f} ms against its commands{then}"
    return Finding(stroke.entry.file, "time_s", text)


def _swapped(
    stroke: StrokeObservation, pressures: Signals, least: float, share: float, then: str = ""
) -> Iterator[Finding]:
    """Yield pairs of gauges whose misfit is at least this [Pa^2] and less than a share if exchanged."""

    def misfit(measured: Floats, predicted: Floats) -> float:
        return float(np.mean((measured - predicted) ** 2))

    for one, two in itertools.combinations(sorted(pressures), 2):
        (a, b, _t), (c, d, _s) = pressures[one], pressures[two]
        if len(a) != len(c):
            continue
        straight, exchanged = misfit(a, b) + misfit(c, d), misfit(a, d) + misfit(c, b)
        if straight > least and exchanged < share * straight:
            yield Finding(stroke.entry.file, f"{one}, {two}", f"channels are {SWAPPED}{then}")


def time_shift(pressures: Signals) -> float:
    """Return the shift of measured against predicted pressures that removes nine tenths of the misfit [s], 0 if none does."""
    if not pressures:
        return 0.0
    coarse = np.arange(-0.03, 0.0301, 0.0005)
    costs = _shift_costs(pressures, coarse)
    here = costs[len(coarse) // 2]
    if not (here > 1e8 and costs.min() < 0.1 * here):
        return 0.0
    fine = float(coarse[int(np.argmin(costs))]) + np.arange(-0.0005, 0.00051, 0.0001)
    return float(fine[int(np.argmin(_shift_costs(pressures, fine)))])


def _shift_costs(pressures: Signals, shifts: Floats) -> Floats:
    """Return the sum of the mean squared misfits of all signals at each shift [shifts]."""
    costs = np.zeros(len(shifts))
    for measured, predicted, time_s in pressures.values():
        for j, shift in enumerate(shifts):
            moved = np.interp(time_s - shift, time_s, predicted)
            costs[j] += float(np.mean((measured - moved) ** 2))
    return costs
