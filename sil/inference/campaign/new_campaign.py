"""A draft of campaign.toml from measured files: columns found by name and unit, channels drawn.

What the files do not say is in the draft as "?", which is refused until it is answered, or as a
comment, and is returned as a question.
Checked by: tests/unit/sil/inference/campaign/test_new_campaign.py
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import load
from sil.campaign.campaign import LARGEST_VALUE, Floats
from sil.campaign.tables import Undecided, read_columns
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value
from sil.inference.campaign.channels import RecordedColumn, commands, pressures, recognise
from sil.report.figure import Figure, Panel, Series, Stack
from sil.report.picture import save

Rig = Literal["actuator", "fixed", "cylinder", "force"]
RIG_CHAMBERS: dict[Rig, str] = {"actuator": "BNF", "fixed": "12", "cylinder": "12", "force": ""}
"""What can be measured, and the chambers that have gauges and valves then."""


def draft(
    folder: Path, files: Sequence[Path], rig: Rig | None = None, force: bool = False
) -> tuple[list[str], list[str]]:
    """Copy files into a folder with a draft of campaign.toml and a picture of the channels.

    rig: what was measured; None where a channel of force shows that it is "force".
    Returns what each column was taken for, and what the files do not say, as questions. Raises
    InputError for a file that cannot be read, for files whose columns differ, for two of the same
    name and, without `force`, where the folder has another file of that name.
    """
    names = [file.name for file in files]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InputError(f"{files[number]}: a second file {name}; expected different names")
    tables, undecided = _read(files)
    for file in files:
        copy = folder / file.name
        if copy.exists() and not force and not file.samefile(copy):
            raise InputError(f"{copy}: exists, and is not {file}; expected none, or --force")
    columns, _dialect, units = tables[0]
    infinite = {
        name
        for table, *_rest in tables
        for name, values in table.items()
        if not np.all(np.abs(values) < LARGEST_VALUE)
    }
    columns = {name: values for name, values in columns.items() if name not in infinite}
    channels = recognise(columns, units, RIG_CHAMBERS[rig or "force"])
    if rig is None and not {c.ours for c in channels} & {"force_n", "torque_n_m"}:
        raise InputError(
            f"{files[0]}: no channel of force, so what was measured? expected --rig actuator (strokes of this "
            "actuator), fixed (its fixed piston), cylinder (one of your own) or force"
        )
    rig = rig or "force"
    if not any(channel.ours != "time_s" for channel in channels):
        raise InputError(f"{files[0]}: no channel but time; expected position and force")
    drawn = [{name: table[name] for name in columns} for table, *_rest in tables]
    level = "absolute" if rig == "force" else pressures(channels, drawn)
    asked = [undecided] if undecided else []
    asked += _questions(rig, channels, level)
    asked += [f"{c.name}: {c.open}" for c in channels if c.open and not c.ours.startswith("cmd_")]
    lines = [*_head(folder.name, rig, channels, columns, level)]
    lines += ['decimal = "?"'] if undecided else []
    lines += ["", *(f"# {text}" for text in asked), "[columns]"]
    lines += map(_column, (channel for channel in channels if _is_mapped(channel)))
    lines += [f"# not used: {toml_value(c.name)}" for c in channels if not c.ours]
    lines += [f"# not used, not finite: {toml_value(name)}" for name in sorted(infinite)]
    for file, (_columns, dialect, _units), table in zip(files, tables, drawn, strict=True):
        lines += ["", "[[stroke]]", f"file = {toml_value(file.name)}"]
        lines += [f"# read as {dialect}"] if dialect else []
        lines += [] if rig == "force" else _conditions(rig, channels, table)
        if not (folder / file.name).exists() or not file.samefile(folder / file.name):
            write_atomically(folder / file.name, file.read_bytes())
    write_atomically(folder / "campaign.toml", "\n".join(lines) + "\n")
    save(_figure(files, drawn, channels), folder, "channels")
    return list(map(str, channels)), asked


def _read(files: Sequence[Path]) -> tuple[list[tuple[dict[str, Floats], str, dict[str, str]]], str]:
    """Read files with the same columns, or raise InputError; return what asks for the decimal sign if none shows it."""
    undecided = ""
    tables = []
    for file in files:
        try:
            tables.append(read_columns(file))
        except Undecided as error:
            undecided = undecided or str(error)
            tables.append(read_columns(file, "."))
    shown = [
        {f"{name} [{units[name]}]" if name in units else name for name in columns}
        for columns, _dialect, units in tables
    ]
    for file, each in zip(files, shown, strict=True):
        if each != shown[0]:
            odd = ", ".join(sorted(each ^ shown[0]))
            raise InputError(f"{file}: other columns than {files[0]}: {odd}; expected the same")
    return tables, undecided


def _questions(rig: Rig, channels: Sequence[RecordedColumn], level: str) -> Iterator[str]:
    """Yield what files of this rig do not say."""
    ours = {channel.ours for channel in channels}
    others = {"position_m": "angle_rad", "force_n": "torque_n_m"}
    asked = {
        "position_m": "no position was found: state position_m (m) or angle_rad (rad)",
        "force_n": "no driving force was found: state force_n (N), torque_n_m (N m), or pressure_pa (Pa) "
        "with piston_area_m2 in [body]; a formula of columns will do, e.g. \"'p1' * 5e-4 - 'p2' * 4e-4\"",
        "time_s": 'no time was found: state time_s, e.g. "row / 1000" for 1000 rows a second',
    }
    for name, text in asked.items():
        if ours.isdisjoint({name, others.get(name, name)}) and (
            rig == "force" or name != "force_n"
        ):
            yield text
    if rig == "force":
        yield "does the force push towards increasing position? If not, scale = -1"
        yield "is there a mass that is known? Then [body] mass_kg = ...; it is fitted otherwise"
        if "pressure_pa" in ours:
            yield (
                "which area does pressure_pa act on, and which way? [body] piston_area_m2, negative if it "
                "pushes towards decreasing position; without it, pressure is a condition only"
            )
            yield "gauge and absolute pressure differ by an offset only: either will do"
        return
    if level == "?":
        yield 'pressures = "gauge" or "absolute"? By their level they may count from the atmosphere'
    if not any(name.startswith("cmd_") for name in ours):
        example = f'[[0.01, "{RIG_CHAMBERS[rig][0]}", 0.98]]'
        yield f"commands of each stroke: when was which valve switched, e.g. {example}?"
    yield "atmosphere_pa and temperature_k: what were they? Standard values are assumed"
    yield "supply_pressure_pa of each stroke: what did the regulator show? A charged chamber shows it"
    yield "load and rest_s of each stroke: nothing coupled to it and 60 s of rest before are assumed"
    if rig == "cylinder":
        yield "the cylinder's data sheet: a model file with [cylinder], given as --model"


def _head(
    name: str,
    rig: Rig,
    channels: Sequence[RecordedColumn],
    columns: Mapping[str, Floats],
    level: str,
) -> Iterator[str]:
    """Yield the keys above the first table."""
    yield f"name = {toml_value(name)}"
    yield f"rig = {toml_value({'actuator': 'length', 'cylinder': 'fixed'}.get(rig, rig))}"
    clock = next((channel for channel in channels if channel.ours == "time_s"), None)
    if clock is not None and clock.scale is not None:
        hertz = 1.0 / (clock.scale * float(np.median(np.diff(columns[clock.name]))))
        yield f"sample_rate_hz = {float(f'{hertz:.6g}')}"
    elif rig != "force":
        yield 'sample_rate_hz = "?"'
    if rig != "force":
        yield from ("atmosphere_pa = 101325.0", "temperature_k = 293.15")
        yield f"pressures = {toml_value(level)}"


def _is_mapped(channel: RecordedColumn) -> bool:
    """Return whether a channel needs a row in [columns]; commands are stated for each stroke."""
    same = channel.ours == channel.name and channel.scale == 1.0
    return bool(channel.ours) and not channel.ours.startswith("cmd_") and not same


def _column(channel: RecordedColumn) -> str:
    source = f"column = {toml_value(channel.name)}"
    if channel.scale is None:
        return f'{channel.ours} = {{ {source}, scale = "?", offset = 0.0 }}'
    return f"{channel.ours} = {{ {source}, scale = {channel.scale!r} }}"


def _conditions(rig: Rig, channels: list[RecordedColumn], table: Mapping[str, Floats]) -> list[str]:
    """Return the conditions of a stroke as its file shows them, "?" for those it does not."""
    by_name = {channel.ours: channel for channel in channels}
    position = by_name.get("position_m")
    ends_m = None
    if position is not None and position.scale:
        values = table[position.name] * position.scale
        count = max(1, len(values) // 50)
        ends_m = float(np.median(values[:count])), float(np.median(values[-count:]))
    charged, changes = commands(channels, table)
    supply_pa: float | str = "?"  # what a chamber shows that was charged before
    for channel in channels:
        if channel.ours in {f"pressure_{chamber}_pa" for chamber in charged} and channel.scale:
            values = table[channel.name]
            first_pa = np.median(values[: max(1, len(values) // 200)]) * channel.scale
            supply_pa = float(f"{first_pa:.3g}")
            break
    has_commands = any(name.startswith("cmd_") for name in by_name)
    values_by_key = {
        "kind": _kind(ends_m) if rig == "actuator" else "fixed",
        "supply_pressure_pa": supply_pa,
        "load": "none",
        "rest_s": 60.0,
        "commands": changes if has_commands else "?",
        "charged_before": charged if has_commands else "?",
    }
    if rig != "actuator" and ends_m and abs(ends_m[0]) > 5e-4:
        values_by_key["start_offset_m"] = round(ends_m[0], 6)
    return [f"{key} = {toml_value(value)}" for key, value in values_by_key.items()]


def _kind(ends_m: tuple[float, float] | None) -> str:
    """Return the kind of a stroke between two positions from neutral [m], "?" for none of ours."""
    stroke_m = load("nominal").value("length.stroke")
    places = [x / stroke_m for x in ends_m or ()]
    if any(abs(place - round(place)) > 0.2 for place in places):
        return "?"
    kinds: dict[tuple[int, ...], str]
    kinds = {(0, 1): "N-B", (1, 0): "B-N", (0, -1): "N-F", (-1, 0): "F-N"}
    return kinds.get(tuple(map(round, places)), "?")


def _figure(
    files: Sequence[Path],
    tables: Sequence[Mapping[str, Floats]],
    channels: Sequence[RecordedColumn],
) -> Figure:
    """Return every channel as it is in the files, one stack a file (of the first four)."""
    stacks = []
    clock = next((c for c in channels if c.ours == "time_s" and c.scale), RecordedColumn(""))
    axis = "time, s" if clock.name else "row"
    for file, columns in list(zip(files, tables, strict=True))[:4]:
        count = len(next(iter(columns.values())))
        x = np.asarray(columns.get(clock.name, np.arange(float(count))) * (clock.scale or 1.0))
        rows = np.linspace(0, count - 1, min(count, 4000)).astype(int)
        panels = []
        for name, ours in ((c.name, c.ours) for c in channels if c.name != clock.name):
            line = Series(name, x[rows], columns[name][rows], "measured")
            panels.append(Panel(f"{name}: {ours or 'not used'}", "", [line], height=110))
        stacks.append(Stack(f"{axis} ({file.name})", panels))
    return Figure(stacks)
