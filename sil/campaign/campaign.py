"""Measurement campaigns: a folder with campaign.toml and one CSV a stroke, read and written.

The same format holds measured strokes and simulated ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.parameters import read_toml
from plant.systems.stroke import KINDS, Stroke, StrokeConditions

Floats = NDArray[np.float64]

TOP_KEYS = {"name", "rig", "atmosphere_pa", "temperature_k", "sample_rate_hz", "stroke", "columns"}
STROKE_KEYS = {
    "file",
    "label",
    "kind",
    "supply_pressure_pa",
    "load",
    "spring_n_per_m",
    "start_offset_m",
    "rest_s",
    "commands",
    "charged_before",
    "damper_model",
    "flow_model",
    "mounted",
    "mesh_force_n",
    "sync_impulse_n_s",
}
RIGS = ("fixed", "length", "both")
LOADS = ("none", "damper", "spring")
DAMPER_MODELS = ("compressible", "incompressible")
FLOW_MODELS = ("mapped", "theoretical")
DECIMALS = {"time_s": 4, "position_m": 7, "position_internal_m": 7}


@dataclass(frozen=True)
class ColumnMap:
    """Where one of our columns comes from in another rig's file: theirs * scale + offset."""

    theirs: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class CampaignStroke:
    """One stroke's conditions and the file that holds it."""

    file: str
    label: str
    conditions: StrokeConditions


@dataclass(frozen=True)
class Campaign:
    """A measurement campaign: public conditions, one entry a stroke.

    Times in s, pressures absolute in Pa; see the campaign format.
    """

    folder: Path
    name: str
    rig: str
    atmosphere_pa: float
    temperature_k: float
    sample_rate_hz: float
    strokes: tuple[CampaignStroke, ...]
    columns: Mapping[str, ColumnMap] = field(default_factory=dict)

    def record(self, stroke: CampaignStroke) -> Record:
        """Read a stroke's CSV; InputError names file and line of what is wrong."""
        return read_record(self.folder / stroke.file, self.columns)


@dataclass(frozen=True)
class Record:
    """The columns of one stroke's CSV, by our names."""

    path: Path
    columns: Mapping[str, Floats]

    @property
    def time_s(self) -> Floats:
        """Instants of the samples [s]."""
        return self.columns["time_s"]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.time_s)


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign folder's campaign.toml (or that file itself).

    Raises
    ------
    InputError : missing folder or file, unknown or missing key, wrong type or value: one line with
        the file, where in it, what is wrong and what was expected
    """
    folder = Path(path)
    file = folder if folder.suffix == ".toml" else folder / "campaign.toml"
    if not file.is_file():
        raise InputError(f"{path}: no campaign.toml; expected a campaign folder")
    raw = read_toml(file)
    name = str(file)
    unknown = sorted(set(raw) - TOP_KEYS)
    if unknown:
        raise InputError(
            f"{name}: {unknown[0]}: unknown key; expected {', '.join(sorted(TOP_KEYS))}"
        )
    strokes = raw.get("stroke")
    if not isinstance(strokes, list) or not strokes:
        raise InputError(f"{name}: no [[stroke]]; expected at least one")
    rig = text(raw, "rig", name, RIGS)
    atmosphere = real(raw, "atmosphere_pa", name, low=1e3, high=2e5)
    temperature = real(raw, "temperature_k", name, low=150.0, high=500.0)
    rate = real(raw, "sample_rate_hz", name, low=1.0, high=1e8)
    parsed = []
    for number, entry in enumerate(strokes, start=1):
        where = f"{name}: stroke {number}"
        if not isinstance(entry, dict):
            raise InputError(f"{where}: expected a table")
        stroke = parse_stroke(entry, where, atmosphere, temperature)
        progress = (number - 1) / (len(strokes) - 1) if len(strokes) > 1 else 1.0
        conditions = replace(stroke.conditions, progress=progress)
        parsed.append(replace(stroke, conditions=conditions))
    return Campaign(
        folder=file.parent,
        name=text(raw, "name", name),
        rig=rig,
        atmosphere_pa=atmosphere,
        temperature_k=temperature,
        sample_rate_hz=rate,
        strokes=tuple(parsed),
        columns=parse_columns(raw.get("columns", {}), name),
    )


def parse_stroke(
    entry: Mapping[str, Any], where: str, atmosphere_pa: float, temperature_k: float
) -> CampaignStroke:
    """One [[stroke]] table as conditions; InputError names the key.

    Raises InputError naming the key.
    """
    unknown = sorted(set(entry) - STROKE_KEYS)
    if unknown:
        raise InputError(
            f"{where}: {unknown[0]}: unknown key; expected {', '.join(sorted(STROKE_KEYS))}"
        )
    kind = text(entry, "kind", where, KINDS)
    valves = ("1", "2") if kind == "fixed" else ("B", "N", "F")
    commands = []
    raw_commands = entry.get("commands")
    if not isinstance(raw_commands, list):
        raise InputError(f"{where}: commands: expected a list of [time_s, valve, duty]")
    for index, command in enumerate(raw_commands, start=1):
        command_at = f"{where}: command {index}"
        if not isinstance(command, list) or len(command) != 3:
            raise InputError(f"{command_at}: expected [time_s, valve, duty], got {command!r}")
        when = finite(command[0], f"{command_at}: time", 0.0, 1e5)
        if command[1] not in valves:
            raise InputError(f"{command_at}: valve {command[1]!r}; expected {', '.join(valves)}")
        commands.append(
            (when, str(command[1]), finite(command[2], f"{command_at}: duty", 0.0, 1.0))
        )
    if any(late[0] < early[0] for early, late in pairwise(commands)):
        commands.sort(key=lambda command: command[0])
    charged = entry.get("charged_before", [])
    if not isinstance(charged, list) or any(name not in valves for name in charged):
        raise InputError(f"{where}: charged_before: {charged!r}; expected of {', '.join(valves)}")
    load = text(entry, "load", where, LOADS) if "load" in entry else "none"
    mounted = entry.get("mounted", False)
    if not isinstance(mounted, bool):
        raise InputError(f"{where}: mounted: expected true or false, got {mounted!r}")
    file = text(entry, "file", where)
    if Path(file).name != file or not file.isprintable():
        raise InputError(
            f"{where}: file {file!r}; expected the name of a file next to campaign.toml"
        )

    def optional(key: str, default: float, low: float, high: float) -> float:
        return real(entry, key, where, low=low, high=high) if key in entry else default

    return CampaignStroke(
        file=file,
        label=text(entry, "label", where) if "label" in entry else kind,
        conditions=StrokeConditions(
            kind=kind,
            supply_pressure_pa=real(entry, "supply_pressure_pa", where, low=1e4, high=5e6),
            commands=tuple(commands),
            atmosphere_pa=atmosphere_pa,
            temperature_k=temperature_k,
            load=load,
            spring_n_per_m=optional("spring_n_per_m", 0.0, 0.0, 1e8),
            start_offset_m=optional("start_offset_m", 0.0, -1.0, 1.0),
            charged_before=tuple(charged),
            damper_model=(
                text(entry, "damper_model", where, DAMPER_MODELS)
                if "damper_model" in entry
                else "compressible"
            ),
            theoretical_flow=(
                "flow_model" in entry
                and text(entry, "flow_model", where, FLOW_MODELS) == "theoretical"
            ),
            mounted=mounted,
            mesh_force_n=optional("mesh_force_n", 0.0, 0.0, 1e6),
            sync_impulse_n_s=optional("sync_impulse_n_s", 0.0, 0.0, 1e6),
            rest_s=optional("rest_s", 60.0, 0.0, 1e9),
        ),
    )


def parse_columns(raw: object, name: str) -> dict[str, ColumnMap]:
    """Return the [columns] table: ours = "theirs", or a table with column, scale, offset.

    Raises InputError naming the column.
    """
    if not isinstance(raw, dict):
        raise InputError(f"{name}: [columns]: expected a table")
    columns = {}
    for ours, value in raw.items():
        where = f"{name}: [columns] {ours}"
        if isinstance(value, str):
            columns[ours] = ColumnMap(value)
            continue
        if not isinstance(value, dict) or not isinstance(value.get("column"), str):
            raise InputError(
                f'{where}: expected "theirs" or {{ column = "theirs", scale = , offset = }}'
            )
        unknown = sorted(set(value) - {"column", "scale", "offset"})
        if unknown:
            raise InputError(f"{where}: {unknown[0]}: unknown key; expected column, scale, offset")
        columns[ours] = ColumnMap(
            value["column"],
            finite(value.get("scale", 1.0), f"{where}.scale"),
            finite(value.get("offset", 0.0), f"{where}.offset"),
        )
    return columns


def text(
    table: Mapping[str, Any], key: str, where: str, allowed: Sequence[str] | None = None
) -> str:
    """Return a non-empty text of a table, one of `allowed` if given.

    Raises InputError naming the key.
    """
    if key not in table:
        raise InputError(f"{where}: no {key}")
    value = table[key]
    if not isinstance(value, str) or not value:
        raise InputError(f"{where}: {key}: expected a text, got {value!r}")
    if allowed is not None and value not in allowed:
        raise InputError(f"{where}: {key}: {value!r}; expected {', '.join(allowed)}")
    return value


def real(table: Mapping[str, Any], key: str, where: str, *, low: float, high: float) -> float:
    """Return a number of a table within [low, high].

    Raises InputError naming the key.
    """
    if key not in table:
        raise InputError(f"{where}: no {key}")
    return finite(table[key], f"{where}: {key}", low, high)


def finite(value: object, where: str, low: float = -1e300, high: float = 1e300) -> float:
    """Return a finite number within [low, high], or InputError naming where.

    Raises InputError naming where it was read.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where}: expected a number, got {value!r}")
    if not low <= value <= high:  # nor not-a-number, nor what is too large for a float
        raise InputError(f"{where}: {value!r}; expected {low:g} to {high:g}")
    return float(value)


def read_record(path: Path, columns: Mapping[str, ColumnMap] | None = None) -> Record:
    """Read a stroke's CSV: header row, comma, dot; every cell a finite number.

    Raises InputError with the line of a torn row, a cell that is no number, time that does not
    increase, or a missing time_s or position_m.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        lines = raw.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: line {line}: not ASCII text; expected CSV") from None
    if not lines or not lines[0].strip():
        raise InputError(f"{path}: line 1: empty; expected a header row")
    header = [name.strip() for name in lines[0].split(",")]
    if len(set(header)) != len(header):
        raise InputError(f"{path}: line 1: a column name occurs twice")
    body = lines[1:]
    if not raw.endswith(b"\n") and body and len(body[-1].split(",")) != len(header):
        raise InputError(
            f"{path}: line {len(lines)}: torn: {len(body[-1].split(','))} cells, "
            f"expected {len(header)}"
        )
    table = parse_cells(path, body, len(header))
    if len(table) < 2:
        raise InputError(f"{path}: {len(table)} samples; expected at least 2")
    found = {name: table[:, k] for k, name in enumerate(header)}
    for ours, source in (columns or {}).items():
        if source.theirs not in header:
            raise InputError(
                f"{path}: line 1: no column {source.theirs!r} (mapped to {ours}); "
                f"there are {', '.join(header)}"
            )
        found[ours] = table[:, header.index(source.theirs)] * source.scale + source.offset
    if "time_s" not in found:
        raise InputError(f"{path}: line 1: no column time_s; there are {', '.join(header)}")
    steps = np.diff(found["time_s"])
    if np.any(steps <= 0.0):
        line = int(np.argmax(steps <= 0.0)) + 3
        raise InputError(f"{path}: line {line}: time_s does not increase")
    return Record(path, found)


def parse_cells(path: Path, body: Sequence[str], width: int) -> Floats:
    """Rows of numbers as an array; the slow path runs only to name the line that is wrong.

    Result [rows, width], in the units of the file. Raises InputError naming the line.
    """
    try:
        table = np.loadtxt(body, delimiter=",", ndmin=2) if body else np.zeros((0, width))
        if table.shape[1] == width and np.all(np.isfinite(table)):
            return table
    except ValueError:
        pass
    for number, row in enumerate(body, start=2):
        cells = row.split(",")
        if len(cells) != width:
            raise InputError(f"{path}: line {number}: {len(cells)} cells, expected {width}")
        for cell in cells:
            try:
                value = float(cell)
            except ValueError:
                raise InputError(
                    f"{path}: line {number}: {cell.strip()[:30]!r} is not a number"
                ) from None
            if not math.isfinite(value):
                raise InputError(f"{path}: line {number}: {cell.strip()!r} is not finite")
    raise InputError(f"{path}: no rows of numbers; expected {width} columns")


def stroke_columns(stroke: Stroke) -> dict[str, Floats]:
    """Return a simulated stroke as the columns of the campaign format, in their order.

    Columns [n] in SI units.
    """
    chambers = stroke.conditions.chambers
    columns = {"time_s": stroke.time_s, "position_m": stroke.position_m}
    for name in chambers:
        columns[f"pressure_{name}_pa"] = stroke.pressure_pa(name)
    if stroke.conditions.load == "damper":
        columns["pressure_oil2_pa"] = stroke.oil_pressure_pa()
    for index, name in enumerate(chambers):
        columns[f"cmd_{name}"] = stroke.duty[:, index]
    columns["position_internal_m"] = stroke.internal_m
    return columns


def write_record(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write one stroke's CSV with the decimals that the format's instruments resolve.

    columns: [n] each, in SI units.
    """
    formats = []
    for name in columns:
        decimals = DECIMALS.get(name, 3 if name.startswith("cmd_") else 1)
        formats.append(f"%.{decimals}f")
    table = np.column_stack(list(columns.values()))
    row = ",".join(formats) + "\n"
    # one formatting call for the whole table: np.savetxt makes one a row and takes twice as long
    rows = (row * len(table)) % tuple(table.ravel().tolist())
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(columns) + "\n" + rows)


def campaign_toml(campaign: Campaign, strokes: Iterable[CampaignStroke]) -> str:
    """Return the text of campaign.toml for a campaign."""
    lines = [
        f"name = {quoted(campaign.name)}",
        f'rig = "{campaign.rig}"',
        f"atmosphere_pa = {campaign.atmosphere_pa!r}",
        f"temperature_k = {campaign.temperature_k!r}",
        f"sample_rate_hz = {campaign.sample_rate_hz!r}",
    ]
    for stroke in strokes:
        c = stroke.conditions
        commands = ", ".join(f'[{t!r}, "{valve}", {duty!r}]' for t, valve, duty in c.commands)
        charged = ", ".join(f'"{name}"' for name in c.charged_before)
        lines += [
            "",
            "[[stroke]]",
            f"file = {quoted(stroke.file)}",
            f"label = {quoted(stroke.label)}",
            f'kind = "{c.kind}"',
            f"supply_pressure_pa = {c.supply_pressure_pa!r}",
            f'load = "{c.load}"',
            f"spring_n_per_m = {c.spring_n_per_m!r}",
            f"start_offset_m = {c.start_offset_m!r}",
            f"rest_s = {c.rest_s!r}",
            f"commands = [{commands}]",
            f"charged_before = [{charged}]",
        ]
        if c.load == "damper":
            lines.append(f'damper_model = "{c.damper_model}"')
        if c.theoretical_flow:
            lines.append('flow_model = "theoretical"')
        if c.mounted:
            lines.append("mounted = true")
        if c.mesh_force_n:
            lines.append(f"mesh_force_n = {c.mesh_force_n!r}")
        if c.sync_impulse_n_s:
            lines.append(f"sync_impulse_n_s = {c.sync_impulse_n_s!r}")
    return "\n".join(lines) + "\n"


def quoted(value: str) -> str:
    """Return a TOML basic string."""
    import json

    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
