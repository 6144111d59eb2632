"""What the live bench computes: a scenario with the user's changes, run in memory, as JSON for the page.

Nothing is remembered between two calls: all that the page shows follows from what it asks, which is
also the scenario file or the command that it offers to copy.
Checked by: tests/unit/sil/live/test_bench.py
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from can_dbc.codec import decode, message_type_of
from can_dbc.errors import CodecError, InputError
from can_dbc.frame import Frame
from controller import strategies
from sil.coupling.clock import NS_PER_S
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.files.overrides import setting_texts
from sil.recording.run_record import CHAMBERS, RunRecord
from sil.recording.trace_csv import held
from sil.report.figure import MM, MS
from sil.report.live_figure import comparison_figure
from sil.report.plots import content, rounded
from sil.report.run_figure import run_figure
from sil.simulation import load_scenario
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import FAULT_TABLES, Request, Scenario, expanded
from sil.simulation.scenario_text import scenario_toml

if TYPE_CHECKING:
    import can

LONGEST_S = 20.0
"""Longest run of the page: a request is answered by a run from its beginning."""

SLIDERS: Mapping[str, tuple[str, float, float, float, str]] = {
    "sensor.delay_s": ("sensor delay", 0.0, 0.03, 1e3, "ms"),
    "sensor.period_s": ("sensor period", 0.0025, 0.02, 1e3, "ms"),
    "controller.period_s": ("firmware period", 0.0025, 0.02, 1e3, "ms"),
    "controller.filter.fc_hz": ("filter corner frequency", 2.0, 50.0, 1.0, "Hz"),
    "valve.D_rise": ("valve opens after", 0.001, 0.02, 1e3, "ms"),
    "valve.D_fall": ("valve closes after", 0.001, 0.06, 1e3, "ms"),
    "bus.extra_load": ("other traffic on the bus", 0.0, 0.9, 100.0, "%"),
    "plant.supply_pressure_pa": ("supply pressure", 5e5, 1e6, 1e-5, "bar"),
    "driveline.impulse_backward_n_s": ("synchronizer, backward", 1.0, 250.0, 1.0, "N s"),
    "driveline.impulse_forward_n_s": ("synchronizer, forward", 1.0, 250.0, 1.0, "N s"),
    "plant.mesh_force_n": ("teeth", 0.0, 2500.0, 1.0, "N"),
}
"""Path: name, lowest and highest value in SI units, factor to the unit shown, that unit."""

METRICS = (
    ("shift_time_s", "request to stop", MS, "ms"),
    ("impact_speed_m_s", "impact speed", 1.0, "m/s"),
    ("impact_energy_j", "impact energy", 1.0, "J"),
    ("position_lag_10_s", "estimate late at 10 %", MS, "ms"),
    ("position_lag_90_s", "estimate late at 90 %", MS, "ms"),
    ("air_used_kg", "air used", 1e3, "g"),
)


class Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a page asks to run: a scenario and how it differs from its file.

    `requests`: in place of the scenario's; `faults`: further ones by the name of their table.
    """

    scenario: str
    settings: dict[str, bool | int | float | str] = {}
    requests: list[Request] | None = None
    faults: dict[Literal[FAULT_TABLES], list[dict[str, Any]]] = {}  # type: ignore[valid-type]
    duration_s: float | None = None


def load_asked(asked: Asked, scenarios: Mapping[str, str]) -> Loaded:
    """Return the scenario that is asked for; `scenarios`: the files or shipped names that may be used.

    Raises InputError for another scenario, a value that is not the page's to set, a run
    that is too long, and as the scenario itself does.
    """
    if asked.scenario not in scenarios:
        raise InputError(f"scenario: {asked.scenario!r}; expected one of {', '.join(scenarios)}")
    fixed = {"firmware", "model_set", "effects", "bus.guest", "duration_s"}
    for path in asked.settings:  # these name files or other programs, or are set otherwise
        if fixed & {path, path.split(".")[0]}:
            raise InputError(f"settings: {path}: cannot be set from the page; expected another")
    table, path_of_file = load_scenario.read(scenarios[asked.scenario])
    if asked.requests is not None:
        table["request"] = msgspec.to_builtins(asked.requests)
    for name, faults in asked.faults.items():
        table[name] = [*table.get(name, []), *faults]
    if asked.duration_s is not None:
        table["duration_s"] = asked.duration_s
    loaded = load_scenario.from_table(
        table, asked.scenario, folder=path_of_file.parent, settings=asked.settings
    )
    duration_s, period_s = loaded.scenario.duration_s, loaded.scenario.trace_period_s
    max_steps = 200_000
    if duration_s > LONGEST_S or duration_s / period_s > max_steps:
        raise InputError(
            f"duration_s: {duration_s:g} s in steps of {period_s:g} s; expected at most "
            f"{LONGEST_S:g} s and {max_steps} steps"
        )
    return loaded


def run_shift(asked: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return a run as the tabs Shift and Bus show it. Raises InputError and RunError."""
    loaded = load_asked(asked, scenarios)
    run = run_in_memory(loaded)
    record = run.record
    stacks = run_figure(record, run.shifts).stacks
    return {
        **_again(asked, loaded, run),
        "duration_ms": MS * loaded.scenario.duration_s,
        "tick_ms": MS * loaded.scenario.controller.period_s,
        "stroke_mm": MS * record.stroke_m,
        "free_mm": MS * record.free_travel_m,
        "supply_bar": 1e-5 * record.supply_pressure_pa,
        "bus_load": _load(record, loaded.scenario),
        "trace": dict(_trace(record)),
        "frames": list(_frames(record)),
        "requests": msgspec.to_builtins(loaded.scenario.request),
        "metrics": _metrics([run.metrics]),
        "plots": content(stacks[0]),
    }


def compare(before: Asked, after: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return two runs over each other as the tab What if shows them. Raises InputError and RunError."""
    first, second = (
        _cached(msgspec.json.encode(asked, order="sorted"), tuple(scenarios.items()))
        for asked in (before, after)
    )
    figure = comparison_figure(first[1], second[1])
    return {
        **_again(after, *second),
        "metrics": _metrics([first[1].metrics, second[1].metrics]),
        "plots": content(figure.stacks[0]),
    }


@functools.lru_cache(16)
def _cached(asked: bytes, scenarios: tuple[tuple[str, str], ...]) -> tuple[Loaded, Run]:
    loaded = load_asked(msgspec.json.decode(asked, type=Asked), dict(scenarios))
    return loaded, run_in_memory(loaded)


def _again(asked: Asked, loaded: Loaded, run: Run) -> dict[str, Any]:
    """Return what makes the same run without the page, and its hash."""
    changed = asked.requests is not None or asked.faults or asked.duration_s is not None
    words = ["opc4", "run", asked.scenario]
    words += [word for text in setting_texts(asked.settings) for word in ("--set", text)]
    return {
        "name": asked.scenario,
        "command": "" if changed else shlex.join(words),
        "toml": scenario_toml(loaded.scenario),
        "trace_sha256": run.trace_sha256,
    }


def _load(record: RunRecord, scenario: Scenario) -> float:
    """Return the share of the run in which the bus carried frames of the record."""
    frames = (entry.frame for entry in record.frames)
    bits = sum(frame_bits(f.can_id, f.data) + INTERMISSION_BITS for f in frames)
    return bits / (scenario.bus.bitrate * scenario.duration_s)


def _metrics(runs: Sequence[Mapping[str, Any]]) -> list[list[Any]]:
    return [
        [name, unit, *(None if run[key] is None else factor * run[key] for run in runs)]
        for key, name, factor, unit in METRICS
    ]


def _trace(record: RunRecord) -> Iterator[tuple[str, list[float | None]]]:
    truth = record.truth
    yield "time_ms", rounded(MS * truth["time_s"], 8)
    for column, name, factor in (
        ("position_m", "stay_mm", MM),
        ("piston_1_m", "piston_1_mm", MM),
        ("piston_2_m", "piston_2_mm", MM),
        *((f"pressure_{c}_pa", f"pressure_{c}_bar", 1e-5) for c in CHAMBERS),
        *((f"cmd_{c}", f"coil_{c}", 1.0) for c in CHAMBERS),
        *((f"valve_{c}", f"valve_{c}", 1.0) for c in CHAMBERS),
    ):
        yield name, rounded(factor * truth[column], 5)
    at_s, estimate_m = record.estimate
    yield "estimate_mm", rounded(MM * held(at_s, estimate_m, truth["time_s"]), 5)


def heard(message: can.Message, start_s: float) -> list[Any]:
    """Return a frame of another process's run as `_frames` gives one, its time from `start_s` on."""
    frame = Frame(message.arbitration_id, bytes(message.data))
    at_ms = round(MS * (message.timestamp - start_s), 4)
    try:
        signals = _signals(decode(frame))
    except CodecError:
        signals = ""
    return [at_ms, at_ms, "", *_shown_frame(frame), signals]


def _frames(record: RunRecord) -> Iterator[list[Any]]:
    """Yield (released ms, arrival ms, sender, message, identifier, data, signals) of each frame."""
    signals = {
        id(entry): _signals(message)
        for entries in record.messages.values()
        for entry, message in entries
    }
    for entry in record.frames:
        released, arrival = (round(MS * at / NS_PER_S, 4) for at in entry[:2])
        shown = _shown_frame(entry.frame)
        yield [released, arrival, entry.sender, *shown, signals.get(id(entry), "")]


def _signals(message: Any) -> str:
    names = (field.name for field in dataclasses.fields(message))
    return ", ".join(f"{name} {_shown(getattr(message, name))}" for name in names)


def _shown_frame(frame: Frame) -> list[str]:
    message = message_type_of(frame.can_id)
    return [message.__name__ if message else "", f"{frame.can_id:08X}", frame.data.hex(" ").upper()]


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else getattr(value, "name", str(value))


def vocabulary(scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return what the page offers: scenarios, sliders with their present values, faults, strategies."""
    schema = json.loads(json.dumps(msgspec.json.schema(Scenario)))
    kinds = schema["$defs"]
    faults = {}
    for table in FAULT_TABLES:
        items = kinds["Scenario"]["properties"][table]["items"]
        faults[table] = [kinds[ref["$ref"].split("/")[-1]] for ref in items.get("anyOf", [items])]
    return {
        "scenarios": list(scenarios),
        "strategies": list(strategies.NAMES),
        "faults": faults,
        "longest_s": LONGEST_S,
    }


def values_of(asked: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return the values that sliders and choices have in a scenario. Raises InputError."""
    loaded = load_asked(asked, scenarios)
    table = expanded(loaded.scenario)
    if table["plant"]["supply_pressure_pa"] is None:
        table["plant"]["supply_pressure_pa"] = loaded.parameters.value("supply.P_s")
    sliders = [
        [
            path,
            *shown,
            loaded.parameters[path].value
            if path in loaded.parameters
            else reduce(getitem, path.split("."), table),
        ]
        for path, shown in SLIDERS.items()
    ]
    return {
        "sliders": sliders,
        "strategy": loaded.scenario.controller.strategy,
        "filter": loaded.scenario.controller.filter.enabled,
        "damper": loaded.scenario.plant.damper,
        "gear": loaded.scenario.initial_gear,
        "requests": msgspec.to_builtins(loaded.scenario.request),
        "duration_s": loaded.scenario.duration_s,
    }
