"""Strokes that could be measured next, on a rig that is known by what was measured on it.

Checked by: tests/unit/sil/inference/campaign/test_next_experiment.py
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.errors import IntegrationError
from plant.kernel.layout import FIXED
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.campaign.campaign import CampaignStroke, Record, stroke_columns
from sil.campaign.simulate import TAIL_S
from sil.inference.campaign.observations import StrokeObservation, observe

CHAMBER_PAIRS = {
    "fixed": ("1", "2"),
    "N-B": ("B", "N"),
    "N-F": ("F", "N"),
    "B-N": ("N", "B"),
    "F-N": ("N", "F"),
}
"""By kind: the chamber that drives, and the one that can be charged before and vented against it."""


def designs(
    strokes: Sequence[StrokeObservation], folder: str, *, every_rest: bool = False
) -> list[CampaignStroke]:
    """Return strokes that the rig can do, each once: what was measured, varied.

    Kinds, loads and springs as measured; supply pressures from the lowest to the highest; the driving
    valve as commanded, 3 s later, or open for 20 or 50 ms; the opposite chamber charged and vented as
    the stroke begins, or not. folder: of their files; every_rest: with the shortest and the longest rest,
    otherwise with the first one.
    """
    measured = [stroke.conditions for stroke in strokes]
    supplies = _supplies(measured)
    rests = sorted({c.rest_s for c in measured})
    rests = sorted({rests[0], rests[-1]}) if every_rest else [measured[0].rest_s]
    distinct = dict.fromkeys(
        replace(
            commanded, commands=commands, supply_pressure_pa=supply_pa, rest_s=rest_s, progress=1.0
        )
        for base in measured
        for commanded in (base, *_against(base))
        for commands in (commanded.commands, *_pulses(commanded), *_later(commanded))
        for supply_pa, rest_s in product(supplies, rests)
    )
    return [
        CampaignStroke(str(Path(folder) / f"design_{number:03d}.csv"), described(c), c)
        for number, c in enumerate(distinct, start=1)
    ]


def described(conditions: StrokeConditions) -> str:
    """Return a stroke's conditions in a few words."""
    c = conditions
    words = [c.kind, f"{c.supply_pressure_pa / 1e5:.3g} bar"]
    if c.load != "none":
        words.append(c.load)
    if c.charged_before:
        words.append(f"{' and '.join(c.charged_before)} charged before")
    begins: dict[str, float] = {}
    for when, valve, duty in c.commands:
        if duty > 0.0:
            begins.setdefault(valve, when)
        elif valve in begins:
            words.append(f"valve {valve} open for {1e3 * (when - begins.pop(valve)):.3g} ms")
    begin_s = min((when for when, _valve, _duty in c.commands), default=0.0)
    if begin_s >= 1.0:
        words.append(f"begun {begin_s:.3g} s into the record")
    return ", ".join([*words, f"after {c.rest_s:.3g} s"])


def _supplies(measured: Sequence[StrokeConditions]) -> list[float]:
    """Return the lowest, the middle and the highest supply pressure measured, at least two."""
    distinct = sorted({c.supply_pressure_pa for c in measured})
    if len(distinct) == 1:
        atmosphere = measured[0].atmosphere_pa
        return [atmosphere + 2.0 / 3.0 * (distinct[0] - atmosphere), *distinct]
    return sorted({distinct[0], distinct[len(distinct) // 2], distinct[-1]})


def _against(base: StrokeConditions) -> Iterator[StrokeConditions]:
    """Yield the stroke against a chamber that holds the piston at supply pressure and is vented as it begins."""
    driving, opposite = CHAMBER_PAIRS[base.kind]
    begins = [when for when, valve, duty in base.commands if valve == driving and duty > 0.0]
    at_rest = base.start_offset_m == 0.0 and not base.charged_before
    if begins and at_rest and all(valve != opposite for _, valve, _ in base.commands):
        commands = tuple(sorted([*base.commands, (begins[0], opposite, 0.0)]))
        yield replace(base, commands=commands, charged_before=(opposite,))


def _pulses(base: StrokeConditions) -> Iterator[tuple[tuple[float, str, float], ...]]:
    """Yield the commands with the driving valve open for 20 or 50 ms, less and more than it takes to close."""
    driving = CHAMBER_PAIRS[base.kind][0]
    driving_commands = [(when, duty) for when, valve, duty in base.commands if valve == driving]
    if not driving_commands or driving_commands[0][1] <= 0.0:
        return
    others = [command for command in base.commands if command[1] != driving]
    begin_s = driving_commands[0][0]
    for pulse_s in (0.02, 0.05):
        pulse = [(begin_s, driving, FULL_DUTY), (round(begin_s + pulse_s, 6), driving, 0.0)]
        yield tuple(sorted([*others, *pulse]))


def _later(base: StrokeConditions) -> Iterator[tuple[tuple[float, str, float], ...]]:
    """Yield the commands 3 s later, if they are at the beginning: a clock that drifts has drifted by then."""
    by_s = 3.0
    if all(when < by_s for when, _valve, _duty in base.commands):
        yield tuple((when + by_s, valve, duty) for when, valve, duty in base.commands)


def imagined(
    entries: Sequence[CampaignStroke],
    strokes: Sequence[StrokeObservation],
    parameters: ParameterSet,
    rate_hz: float,
) -> list[StrokeObservation]:
    """Return strokes as they would be observed, with the channels and the noise of measured ones.

    Those that cannot be simulated, or do not reach nine tenths of a stroke, are left out.
    """
    noise = {c.name: c.noise for stroke in strokes for c in stroke.channels}
    recorded = {*noise, "time_s"}
    if any(stroke.internal is not None for stroke in strokes):
        recorded.add("position_internal_m")
    end_s = max(float(stroke.time_s[-1]) for stroke in strokes)
    observations = []
    for entry in entries:
        last_s = max((when for when, _valve, _duty in entry.conditions.commands), default=0.0)
        time_s = np.arange(round(max(end_s, last_s + TAIL_S) * rate_hz) + 1) / rate_hz
        section = "fixed" if entry.conditions.system == FIXED else "length"
        with suppress(IntegrationError):
            stroke = simulate(parameters, entry.conditions, time_s)
            if np.ptp(stroke.position_m) >= 0.9 * parameters.value(f"{section}.stroke"):
                columns = {n: v for n, v in stroke_columns(stroke).items() if n in recorded}
                record = Record(Path(entry.file), columns)
                observations.append(observe(entry, record, parameters, noise=noise))
    return observations
