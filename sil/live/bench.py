"""What the live bench computes: a scenario with the user's changes, run in memory, as JSON for the page.

Nothing is remembered between two calls: all that the page shows follows from what it asks, which is
also the scenario file or the command that it offers to copy.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from itertools import zip_longest
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from can_dbc.codec import decode, message_type_of
from can_dbc.errors import CodecError, InputError
from can_dbc.frame import Frame
from can_dbc.instants import NS_PER_S
from controller import strategies
from plant.parameters.bounds import bounds
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.files.overrides import setting_texts
from sil.firmware.load import absolute
from sil.recording.run_record import CHAMBERS, RunRecord
from sil.recording.trace_csv import held
from sil.report.figure import BAR, MM, MS
from sil.report.live_figure import bus_stack, comparison_stack
from sil.report.plots import content, rounded
from sil.simulation import load_scenario
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.inputs import named_files
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import FAULT_TABLES, Request, Scenario, expanded, scenario_toml

if TYPE_CHECKING:
    import can

LONGEST_S = 20.0  # longest run of the page: a request is answered by a run from its beginning

SLIDERS: Mapping[str, tuple[str, float, str, float, float]] = {
    "sensor.delay_s": ("sensor delay", MS, "ms", 0.5, 500.0),
    "sensor.period_s": ("sensor period", MS, "ms", 0.5, 20.0),
    "controller.period_s": ("firmware period", MS, "ms", 0.5, 20.0),
    "controller.filter.fc_hz": ("filter corner", 1.0, "Hz", 1.0, 49.0),
    "valve.D_rise": ("valve opens after", MS, "ms", 0.1, 50.0),
    "valve.D_fall": ("valve closes after", MS, "ms", 0.5, 100.0),
    "bus.extra_load": ("other bus traffic", 100.0, "%", 1.0, 300.0),
    "plant.supply_pressure_pa": ("supply pressure", BAR, "bar", 0.1, 20.0),
    "driveline.impulse_backward_n_s": ("synchr. backward", 1.0, "N s", 1.0, 300.0),
    "driveline.impulse_forward_n_s": ("synchr. forward", 1.0, "N s", 1.0, 300.0),
    "plant.mesh_force_n": ("teeth", 1.0, "N", 50.0, 5000.0),
}
"""Path: name, factor from SI to the unit shown, that unit, step and end of the slider in it.

A number field takes the model's whole range."""

METRICS = (
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
    firmware: str = ""
    """A firmware of the user's in place of the scenario's: of the command, never of the page."""


def load_asked(asked: Asked, scenarios: Mapping[str, str]) -> Loaded:
    """Return the scenario that is asked for, one of `scenarios`.

    Raises InputError for another one, a value that is not the page's to set, a run that is too long, and
    as the scenario itself does.
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
    if asked.firmware:
        table["firmware"] = absolute(asked.firmware, Path())
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


def compare(before: Asked, after: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return two runs, before and after a change, for the tab Shift. Raises InputError and RunError."""
    (_, first), (loaded, run) = _run(before, scenarios), _run(after, scenarios)
    record, scenario = run.record, loaded.scenario
    changed = after.requests is not None or after.faults or after.duration_s is not None
    words = ["opc4", "run", after.scenario]
    words += ["--firmware", after.firmware] if after.firmware else []
    words += [word for text in setting_texts(after.settings) for word in ("--set", text)]
    return {
        "name": after.scenario,
        "command": "" if changed else shlex.join(words),
        "toml": scenario_toml(scenario),
        "trace_sha256": run.trace_sha256,
        "duration_ms": MS * scenario.duration_s,
        "tick_ms": MS * scenario.controller.period_s,
        "stroke_mm": MS * record.stroke_m,
        "free_mm": MS * record.free_travel_m,
        "supply_bar": BAR * record.supply_pressure_pa,
        "time_ms": rounded(MS * record.truth["time_s"], 8),
        "trace": dict(_trace(record)),
        "requests": msgspec.to_builtins(scenario.request),
        "metrics": list(_metrics(first, run)),
        "plots": content(comparison_stack(first, run)),
    }


def frames(asked: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return the frames of a run as the tab Bus shows them. Raises InputError and RunError."""
    loaded, run = _run(asked, scenarios)
    sent = (entry.frame for entry in run.record.frames)
    bits = sum(frame_bits(f.can_id, f.data) + INTERMISSION_BITS for f in sent)
    return {
        "bus_load": bits / (loaded.scenario.bus.bitrate * loaded.scenario.duration_s),
        "frames": list(_frames(run.record)),
        "plots": content(bus_stack(run)),
    }


def _run(asked: Asked, scenarios: Mapping[str, str]) -> tuple[Loaded, Run]:
    named = [scenarios.get(asked.scenario, ""), asked.firmware]
    files = named_files(named, (Path(),), set())
    written = tuple(sorted((str(path), path.stat().st_mtime_ns) for path in files))
    return _cached(msgspec.json.encode(asked, order="sorted"), tuple(scenarios.items()), written)


@functools.lru_cache(16)
def _cached(
    asked: bytes, scenarios: tuple[tuple[str, str], ...], _written: tuple[tuple[str, int], ...]
) -> tuple[Loaded, Run]:
    """Run what is asked; `_written`: when its files were, since an edited one is another scenario."""
    loaded = load_asked(msgspec.json.decode(asked, type=Asked), dict(scenarios))
    return loaded, run_in_memory(loaded)


def _metrics(before: Run, after: Run) -> Iterator[list[Any]]:
    """Yield name, unit, value before and now: request to stop of each motion and in sum, and METRICS."""
    for shifts in zip_longest(before.shifts, after.shifts):
        shift = shifts[1] or shifts[0]
        times = [one.shift_time_s if one else None for one in shifts]
        yield _metric(f"{shift.from_gear} to {shift.to_gear}", "ms", MS, times)
    for key, name, factor, unit in (("shift_time_s", "request to stop, sum", MS, "ms"), *METRICS):
        yield _metric(name, unit, factor, [run.metrics[key] for run in (before, after)])


def _metric(name: str, unit: str, factor: float, values: Sequence[float | None]) -> list[Any]:
    return [name, unit, *(None if value is None else factor * value for value in values)]


def _trace(record: RunRecord) -> Iterator[tuple[str, list[float | None]]]:
    truth = record.truth
    for column, name, factor in (
        ("position_m", "stay", MM),
        ("piston_1_m", "piston_1", MM),
        ("piston_2_m", "piston_2", MM),
        *((f"pressure_{c}_pa", f"pressure_{c}", BAR) for c in CHAMBERS),
        *((f"cmd_{c}", f"coil_{c}", 1.0) for c in CHAMBERS),
        *((f"valve_{c}", f"valve_{c}", 1.0) for c in CHAMBERS),
    ):
        yield name, rounded(factor * truth[column], 4)
    at_s, estimate_m = record.estimate
    yield "estimate", rounded(MM * held(at_s, estimate_m, truth["time_s"]), 4)


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
    """Return what the page offers: scenarios, faults, strategies."""
    kinds, faults = _schema(), {}
    for table in FAULT_TABLES:
        items = kinds["Scenario"]["properties"][table]["items"]
        faults[table] = [kinds[ref["$ref"].split("/")[-1]] for ref in items.get("anyOf", [items])]
    return {
        "scenarios": list(scenarios),
        "strategies": list(strategies.NAMES),
        "faults": faults,
        "longest_s": LONGEST_S,
    }


@functools.cache
def _schema() -> dict[str, Any]:
    kinds: dict[str, Any] = json.loads(json.dumps(msgspec.json.schema(Scenario)))["$defs"]
    return kinds


def values_of(asked: Asked, scenarios: Mapping[str, str]) -> dict[str, Any]:
    """Return the scenario's own values; `reset`: the settings that it refuses, and why. Raises InputError."""
    kept: dict[str, Any] = {}
    reset = {}
    for path, value in asked.settings.items():
        try:
            load_asked(msgspec.structs.replace(asked, settings={**kept, path: value}), scenarios)
            kept[path] = value
        except InputError as error:
            reset[path] = str(error)
    loaded = load_asked(msgspec.structs.replace(asked, settings={}), scenarios)
    controller = loaded.scenario.controller
    return {
        "sliders": [_slider(loaded, path, *shown) for path, shown in SLIDERS.items()],
        "strategy": controller.strategy,
        "filter": controller.filter.enabled,
        "damper": loaded.scenario.plant.damper,
        "reset": reset,
    }


def _slider(
    loaded: Loaded, path: str, name: str, factor: float, unit: str, step: float, end: float
) -> dict[str, Any]:
    """Return a slider in the unit shown: the ends of the model, round values between, the scenario's value."""
    if path in loaded.parameters:
        value: Any = loaded.parameters[path].value
        limits = bounds(path, loaded.parameters[path].unit)
    else:
        node: dict[str, Any] = {"$ref": "Scenario"}
        for part in path.split("."):
            kind = next(one for one in node.get("anyOf", [node]) if "$ref" in one)
            node = _schema()[kind["$ref"].split("/")[-1]]["properties"][part]
        node = node.get("anyOf", [node])[0]
        limits = (node["minimum"], node["maximum"])
        value = reduce(getitem, path.split("."), expanded(loaded.scenario))
        if path == "plant.supply_pressure_pa" and value is None:
            value = loaded.parameters.value("supply.P_s")
    low, high = (factor * limit for limit in limits)
    own = None if value is None else float(f"{factor * value:.10g}")
    stops = {low, low if own is None else own, *_round_values(low, min(high, end), step)}
    return {
        "path": path, "name": name, "factor": factor, "unit": unit, "step": step,
        "low": low, "high": high, "own": own, "value": value, "stops": sorted(stops),
    }  # fmt: skip


def _round_values(low: float, high: float, step: float) -> Iterator[float]:
    """Yield multiples of a step between two ends; it grows tenfold from a hundred steps on."""
    value = step * math.ceil(low / step - 1e-9)
    while value <= high + 1e-9 * step:
        yield float(f"{value:.10g}")
        value += step * 10 ** max(0, math.floor(math.log10(max(value, step) / step) - 1 + 1e-9))
