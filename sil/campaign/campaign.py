"""Measurement campaigns: a folder with campaign.toml and one CSV a stroke, read and written.

The same format holds measured strokes and simulated ones.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import asdict
from numpy.typing import NDArray

from can_dbc.errors import InputError, nearest
from can_dbc.typed_toml import convert, read_toml
from can_dbc.user_file import resolved
from plant.systems.stroke import Stroke, StrokeConditions
from sil.campaign.formula import formula
from sil.campaign.tables import Decimal, read_columns
from sil.campaign.units import SCALES
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value
from sil.files.quantity import counted, without_units

Floats = NDArray[np.float64]

TOP = ("name", "rig", "atmosphere_pa", "temperature_k", "sample_rate_hz")

Text = Annotated[str, Meta(min_length=1)]
Rate = Annotated[float, Meta(gt=0.0, le=1e8)]

LARGEST_VALUE = 1e30  # least size of a value that no channel has

OWN_COLUMN = re.compile(
    r"(time_s|position_m|position_internal_m|angle_rad|force_n|torque_n_m|pressure_pa|cmd_[12BNF]|"
    r"pressure_(1|2|B|N|F|oil2)_pa)"
)
"""Names of the format's columns."""


class ColumnMap(Struct, frozen=True, forbid_unknown_fields=True):
    """Where one of our columns comes from in another rig's file: column * scale + offset.

    column: a name, or a formula of names and numbers with + - * / **; a name that is not plain is quoted, `row` counts the rows from 0.
    scale: factor to our unit.
    offset: added after it, in our unit.
    delay_s: by which the channel lags behind time_s.
    """

    column: Text
    scale: float = 1.0
    offset: float = 0.0
    delay_s: Annotated[float, Meta(ge=-1e3, le=1e3)] = 0.0

    def __post_init__(self) -> None:
        if self.scale == 0.0:
            raise InputError("scale: 0 makes every value the same; expected another number")


class StrokeTable(Struct, frozen=True, forbid_unknown_fields=True):
    """One [[stroke]] of campaign.toml.

    file: of the stroke, beside campaign.toml.
    kind: "fixed" of a fixed piston or cylinder, else from where to where: N neutral, B backward, F forward.
    supply_pressure_pa: of the regulator; it counts as `pressures` says.
    commands: each a time from the file's first sample in s, a valve ("1", "2" or "B", "N", "F") and its duty
    from then on.
    label: free text.
    load: what the stay moves against.
    spring_n_per_m: rate of that spring, unloaded at the start.
    start_offset_m: position at the start of a fixed piston.
    rest_s: how long nothing moved before.
    charged_before: valves that were open before time 0, their chambers at the supply pressure; others are at atmosphere.
    damper_model: of the oil in the damper.
    flow_model: of the valves.
    mounted: whether it sits on a gearbox, whose mass and linkage move with it.
    mesh_force_n: peak of a barrier that resists the motion like friction.
    sync_impulse_n_s: impulse after which a synchronizer lets the stay pass.
    """

    file: Text
    kind: Literal["fixed", "N-B", "B-N", "N-F", "F-N"]
    supply_pressure_pa: Annotated[float, Meta(ge=1e4, le=5e6)]
    commands: list[
        tuple[Annotated[float, Meta(ge=0.0, le=1e5)], str, Annotated[float, Meta(ge=0.0, le=1.0)]]
    ]
    label: Text | None = None
    load: Literal["none", "damper", "spring"] = "none"
    spring_n_per_m: Annotated[float, Meta(ge=0.0, le=1e8)] = 0.0
    start_offset_m: Annotated[float, Meta(ge=-1.0, le=1.0)] = 0.0
    rest_s: Annotated[float, Meta(ge=0.0, le=1e9)] = 60.0
    charged_before: tuple[str, ...] = ()
    damper_model: Literal["compressible", "incompressible"] = "compressible"
    flow_model: Literal["mapped", "theoretical"] = "mapped"
    mounted: bool = False
    mesh_force_n: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    sync_impulse_n_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0

    def __post_init__(self) -> None:
        valves = ("1", "2") if self.kind == "fixed" else ("B", "N", "F")
        for index, (_, valve, _) in enumerate(self.commands):
            if valve not in valves:
                what = f"commands[{index}]: valve {valve!r}"
                raise InputError(f"{what}; expected {', '.join(valves)}")
        if not set(self.charged_before) <= set(valves):
            charged = ", ".join(self.charged_before)
            raise InputError(f"charged_before: {charged}; expected of {', '.join(valves)}")
        if Path(self.file).name != self.file or not self.file.isprintable():
            raise InputError(
                f"file: {self.file!r}; expected the name of a file next to campaign.toml"
            )

    def conditions(self, campaign: CampaignTable, progress: float) -> StrokeConditions:
        """Return what the plant has to know; `progress` as in `StrokeConditions`."""
        values = asdict(self)
        del values["file"], values["label"], values["flow_model"]
        values["supply_pressure_pa"] += campaign.gauge_pa
        values["commands"] = tuple(sorted(self.commands, key=lambda command: command[0]))
        return StrokeConditions(
            **values,
            atmosphere_pa=campaign.atmosphere_pa,
            temperature_k=campaign.temperature_k,
            theoretical_flow=self.flow_model == "theoretical",
            progress=progress,
        )


class CampaignTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of campaign.toml.

    name: of the campaign, in results.
    rig: what was measured: strokes of a fixed piston or cylinder, of the shifting actuator, or both.
    atmosphere_pa: ambient pressure, absolute.
    temperature_k: of supply and walls.
    sample_rate_hz: of the files, nominally.
    columns: ours = "theirs", or the table below, for files with other names or units.
    pressures: what pressures in files and supply_pressure_pa count from: vacuum, or atmosphere_pa.
    decimal: the decimal sign, for files that do not show it.
    """

    name: Text
    rig: Literal["fixed", "length", "both"]
    atmosphere_pa: Annotated[float, Meta(ge=1e3, le=2e5)]
    temperature_k: Annotated[float, Meta(ge=150.0, le=500.0)]
    sample_rate_hz: Rate
    stroke: Annotated[list[StrokeTable], Meta(min_length=1)]
    columns: dict[str, Text | ColumnMap] = {}
    pressures: Literal["absolute", "gauge"] = "absolute"
    decimal: Decimal | None = None

    @property
    def gauge_pa(self) -> float:
        """What pressures count from [Pa]."""
        return self.atmosphere_pa if self.pressures == "gauge" else 0.0


@dataclass(frozen=True)
class Recorder:
    """How the files of a campaign are read: [columns], what gauges count from in Pa, decimal sign."""

    columns: Mapping[str, ColumnMap] = field(default_factory=dict)
    gauge_pa: float = 0.0
    decimal: Decimal | None = None


def column_maps(columns: Mapping[str, str | ColumnMap]) -> dict[str, ColumnMap]:
    """Return [columns] with `ours = "theirs"` as the map that it is short for."""
    return {
        ours: ColumnMap(theirs) if isinstance(theirs, str) else theirs
        for ours, theirs in columns.items()
    }


def check_files(files: Sequence[str], source: Path) -> None:
    """Refuse a file of two strokes, however written: it would count twice. Raises InputError."""
    places = [resolved(source.parent / name) for name in files]
    for number, name in enumerate(files):
        if places[number] in places[:number]:
            raise InputError(f"{source}: stroke[{number}].file: {name!r} twice; expected each once")


@dataclass(frozen=True)
class CampaignStroke:
    """One stroke's conditions and the file that holds it, by its path from the campaign's folder."""

    file: str
    label: str
    conditions: StrokeConditions

    @property
    def session(self) -> str:
        """Folder of the file: what was measured on one day, with the same zeros of the gauges."""
        return str(Path(self.file).parent) if Path(self.file).name != self.file else ""


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
    recorder: Recorder = field(default_factory=Recorder)

    def record(self, stroke: CampaignStroke) -> Record:
        """Read a stroke's file, as `read_record` does."""
        return read_record(self.folder / stroke.file, self.recorder)


@dataclass(frozen=True)
class Record:
    """The columns of one stroke's file, by our names; dialect: of a file that is not our CSV."""

    path: Path
    columns: Mapping[str, Floats]
    dialect: str = ""

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


def misspelt_columns(
    strokes: Iterable[tuple[CampaignStroke, Collection[str]]],
) -> list[tuple[str, str, str]]:
    """Return the columns that are not used and resemble a missing one, as files, column and what is wrong.

    strokes: each stroke with the names of its record's columns.
    """
    files: dict[tuple[str, str], list[str]] = {}
    for entry, columns in strokes:
        names = [f"pressure_{chamber}_pa" for chamber in entry.conditions.chambers]
        names += ["pressure_oil2_pa"] if entry.conditions.load == "damper" else []
        missing = [n for n in ("position_m", *names, "position_internal_m") if n not in columns]
        for name in columns:
            if OWN_COLUMN.fullmatch(name):
                continue
            word = name.lower()
            near = [m for m in missing if m.startswith(word)] or nearest(word, missing, 1)
            if near:
                files.setdefault((name, near[0]), []).append(entry.file)
    problems = []
    for (name, lacking), (first, *others) in files.items():
        more = f" and {len(others)} more" if others else ""
        what = (
            f"column not used, and {lacking} is missing; expected that name, or a map in [columns]"
        )
        problems.append((first + more, name, what))
    return problems


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign folder's campaign.toml, or that file itself. Raises InputError for what is wrong in it."""
    folder = Path(path)
    file = folder if folder.suffix == ".toml" else folder / "campaign.toml"
    if not file.is_file():
        what = f"{path}: no campaign.toml; expected a campaign folder"
        if folder.is_dir() and any(folder.iterdir()):
            what += f"; for CAN logs: opc4 diagnose {path}/*"
            what += ", for others: opc4 diagnose --new DIR FILES"
        raise InputError(what)
    raw = read_toml(file)
    rigs = ("fixed", "length", "both", "force")
    if isinstance(raw.get("rig"), str) and raw["rig"] not in rigs:
        raise InputError(f"{file}: rig: {raw['rig']!r}; expected one of {', '.join(rigs)}")
    values = {key: value for key, value in raw.items() if key != "columns"}  # names of columns
    table = convert(raw | without_units(values, str(file)), CampaignTable, str(file))
    check_files([entry.file for entry in table.stroke], file)
    last = len(table.stroke) - 1
    strokes = tuple(
        CampaignStroke(
            entry.file,
            entry.label or entry.kind,
            entry.conditions(table, number / last if last else 1.0),
        )
        for number, entry in enumerate(table.stroke)
    )
    top = {key: getattr(table, key) for key in TOP}
    recorder = Recorder(column_maps(table.columns), table.gauge_pa, table.decimal)
    return Campaign(file.parent, **top, strokes=strokes, recorder=recorder)


def joined(campaigns: Sequence[Campaign]) -> Campaign:
    """Return several campaigns of one unit as one, files by their path; a single one as it is.

    Raises InputError for a campaign that is there twice, and for unlike [columns].
    """
    first, *more = campaigns
    if not more:
        return first
    places = [resolved(one.folder) for one in campaigns]
    for number, one in enumerate(campaigns):
        if places[number] in places[:number]:
            raise InputError(f"{one.folder}: the same campaign twice; expected each once")
        if one.recorder != first.recorder:
            raise InputError(
                f"{one.folder / 'campaign.toml'}: columns: not those of {first.folder}, or "
                "pressures or decimal; expected campaigns of one recorder"
            )
    return replace(
        first,
        folder=Path(),
        name=" + ".join(one.name for one in campaigns),
        rig=first.rig if all(one.rig == first.rig for one in more) else "both",
        strokes=tuple(
            replace(entry, file=str(one.folder / entry.file))
            for one in campaigns
            for entry in one.strokes
        ),
    )


def read_record(path: Path, recorder: Recorder | None = None) -> Record:
    """Read a stroke's file: CSV with header row, comma, dot, or what `sil.campaign.tables` reads.

    A stored unit may follow a name in [columns]: `x` or `x [mm]`. Other columns with values that are not
    finite are left out, and samples that repeat a stamp. Raises InputError with the line of a torn row, a
    cell that is no finite number, time that falls or hardly increases, or a missing time_s.
    """
    recorder = recorder or Recorder()
    channels, dialect, units = read_columns(path, recorder.decimal)
    used = _map_columns(path, recorder.columns, channels, units)
    notes = [dialect]
    if left_out := _without_infinite(path, channels, used):
        notes.append(f"columns with values that are not finite left out: {', '.join(left_out)}")
    for name in channels:
        if OWN_COLUMN.fullmatch(name) and name.startswith("pressure_"):
            channels[name] = channels[name] + recorder.gauge_pa
    steps = np.diff(channels["time_s"])
    fresh = np.append(True, steps > 0.0)
    if np.any(steps < 0.0) or 2 * np.count_nonzero(~fresh) >= len(steps):
        row = int(np.argmax(steps <= 0.0))
        where = f"sample {row + 2}" if dialect else f"line {row + 3}"
        raise InputError(
            f"{path}: {where}: time_s does not increase; expected rising times, or time_s = "
            '"row / RATE" in [columns]'
        )
    if not np.all(fresh):
        channels = {name: values[fresh] for name, values in channels.items()}
        notes.append(f"{counted(int(np.sum(~fresh)), 'sample')} left out that repeat a stamp")
    time_s = channels["time_s"]
    inside = np.ones(len(time_s), dtype=bool)
    for ours, source in recorder.columns.items():
        if source.delay_s:
            late_s = time_s + source.delay_s
            inside &= (late_s >= time_s[0]) & (late_s <= time_s[-1])
            channels[ours] = np.interp(late_s, time_s, channels[ours])
    if not np.any(inside):
        raise InputError(f"{path}: delay_s: longer than the record of {np.ptp(time_s):.4g} s")
    channels = {name: values[inside] for name, values in channels.items()}
    return Record(path, channels, ", ".join(filter(None, notes)))


def _map_columns(
    path: Path, columns: Mapping[str, ColumnMap], channels: dict[str, Floats], units: dict[str, str]
) -> set[str]:
    """Add our columns to those of a file [n]; return the names that are used.

    Raises InputError for a source that the file does not have, and for one of ours in another unit.
    """
    header = list(channels)
    sources = {f"{n} [{u}]": channels[n] for n, u in units.items() if n in channels} | channels
    used: set[str] = set()
    for ours, source in columns.items():
        column = source.column
        try:
            values = sources[column] if column in sources else formula(column, sources)
        except (KeyError, ValueError):
            raise InputError(
                f"{path}: no column {column!r} (mapped to {ours}); "
                f"expected one of {', '.join(header)}"
            ) from None
        channels[ours] = sources[ours] = values * source.scale + source.offset
        used |= {ours, column}
    for name in sorted(units.keys() & channels.keys() - set(columns)):
        if OWN_COLUMN.fullmatch(name) and SCALES.get(units[name], (name, 1.0))[1] != 1.0:
            raise InputError(
                f"{path}: {name}: stored in {units[name]}; expected SI, or its scale in [columns]"
            )
    if "time_s" not in channels:
        raise InputError(
            f"{path}: no column time_s among {', '.join(channels)}; expected it, or a map in [columns]"
        )
    return used


def _without_infinite(path: Path, channels: dict[str, Floats], used: set[str]) -> list[str]:
    """Take out columns [n] that are not finite; return their names. Raises InputError for one in use."""
    left_out = []
    for name in list(channels):
        finite = np.abs(channels[name]) < LARGEST_VALUE
        if np.all(finite):
            continue
        if name in used or OWN_COLUMN.fullmatch(name):
            row = int(np.argmin(finite))
            raise InputError(
                f"{path}: {name}: sample {row + 1}: {channels[name][row]:g}; "
                "expected a number below 1e30"
            )
        left_out.append(name)
        del channels[name]
    return left_out


def stroke_columns(stroke: Stroke) -> dict[str, Floats]:
    """Return a simulated stroke as the columns [n] of the campaign format, in SI units and their order."""
    chambers = stroke.conditions.chambers
    columns = {"time_s": stroke.time_s, "position_m": stroke.position_m}
    columns |= {f"pressure_{name}_pa": stroke.pressure_pa(name) for name in chambers}
    if stroke.conditions.load == "damper":
        columns["pressure_oil2_pa"] = stroke.oil_pressure_pa()
    columns |= {f"cmd_{name}": stroke.duty[:, index] for index, name in enumerate(chambers)}
    return columns | {"position_internal_m": stroke.internal_m}


def write_record(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write a stroke's columns [n], in SI units, as CSV with the decimals that its instruments resolve."""
    decimals = {"time_s": 4, "position_m": 7, "position_internal_m": 7}
    formats = [f"%.{decimals.get(name, 3 if name.startswith('cmd_') else 1)}f" for name in columns]
    table = np.column_stack(list(columns.values()))
    # one formatting call for the whole table: np.savetxt makes one a row and takes twice as long
    rows = ((",".join(formats) + "\n") * len(table)) % tuple(table.ravel().tolist())
    write_atomically(path, ",".join(columns) + "\n" + rows)


def campaign_toml(campaign: Campaign, strokes: Iterable[CampaignStroke]) -> str:
    """Return the text of campaign.toml for a campaign."""
    keys = (
        "kind supply_pressure_pa load spring_n_per_m start_offset_m rest_s commands charged_before"
    )
    recorder = campaign.recorder
    top: dict[str, object] = {key: getattr(campaign, key) for key in TOP}
    top |= {"pressures": "gauge"} if recorder.gauge_pa else {}
    top |= {"decimal": recorder.decimal} if recorder.decimal else {}
    lines = _assignments(top)
    for stroke in strokes:
        c = stroke.conditions
        values: dict[str, object] = {"file": stroke.file, "label": stroke.label}
        values |= {key: getattr(c, key) for key in keys.split()}
        values["supply_pressure_pa"] = c.supply_pressure_pa - recorder.gauge_pa
        if c.load == "damper":
            values["damper_model"] = c.damper_model
        if c.theoretical_flow:
            values["flow_model"] = "theoretical"
        optional = ("mounted", "mesh_force_n", "sync_impulse_n_s")
        values |= {key: getattr(c, key) for key in optional if getattr(c, key)}
        lines += ["", "[[stroke]]", *_assignments(values)]
    if recorder.columns:
        lines += ["", "[columns]"]
    for name, source in recorder.columns.items():
        lines.append(f"{name} = {{ {', '.join(_assignments(asdict(source)))} }}")
    return "\n".join(lines) + "\n"


def _assignments(values: Mapping[str, object]) -> list[str]:
    return [f"{key} = {toml_value(value)}" for key, value in values.items()]
