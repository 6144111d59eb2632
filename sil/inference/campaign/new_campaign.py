"""A draft of campaign.toml from measured files: columns found by name and unit, channels drawn.

What the files do not say is in the draft as a comment and is returned as a question.
Checked by: tests/unit/sil/inference/campaign/test_new_campaign.py
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError
from sil.campaign.campaign import LARGEST, Floats
from sil.campaign.tables import SCALES, read_columns
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value
from sil.report.figure import Figure, Panel, Series, Stack
from sil.report.picture import save

NAMES = {
    "time_s": r"t|time|zeit|timestamp|.*_t(ime)?",
    "position_m": r"x|y|qm?|pos(ition)?|weg|stroke|displacement|travel|s",
    "angle_rad": r"angle|theta|phi|winkel",
    "force_n": r"f|force|kraft|load(cell)?|u?force",
    "torque_n_m": r"torque|tau|moment|drehmoment",
    "pressure_pa": r"p\d?|pressure|druck|.*press(ure)?",
}
"""Names by which a channel is recognised if no unit identifies it."""

ASKED = {
    "position_m": "no position was found: state position_m (m) or angle_rad (rad)",
    "force_n": "no driving force was found: state force_n (N), torque_n_m (N m), or pressure_pa (Pa) "
    "with piston_area_m2 in [body]; a formula of columns will do, e.g. \"'p1' * 5e-4 - 'p2' * 4e-4\"",
    "time_s": 'no time was found: state time_s, e.g. "row / 1000" for 1000 rows a second',
}
ALWAYS = (
    "does the force push towards increasing position? If not, scale = -1",
    "is there a mass that is known? Then [body] mass_kg = ...; it is fitted otherwise",
)
PRESSURE = (
    "which area does pressure_pa act on, and which way? [body] piston_area_m2, negative if it pushes "
    "towards decreasing position; without it, pressure is a condition only",
    "gauge and absolute pressure differ by an offset only: either will do",
)


def unit_of(name: str) -> str:
    """Return the unit in a column's name: x [mm], x (mm), x_mm, x/mm; empty if there is none."""
    match = re.search(r"[\[(/]\s*([^\])]+?)\s*[\])]?$", name) or re.search(r"_([A-Za-zµ°]+)$", name)
    return match.group(1) if match and match.group(1) in SCALES else ""


def guess(
    columns: Mapping[str, Floats], units: Mapping[str, str]
) -> dict[str, tuple[str, float, bool]]:
    """Return column, scale and whether a unit was stated, by our name, of what the names and values show.

    columns: [n] each, in the file's units; units: those stored apart from the names.
    """
    sources: dict[str, tuple[str, float, bool]] = {}
    for name, values in columns.items():
        stored = units[name] if units.get(name) in SCALES else ""
        if name in NAMES:
            fits = stored and SCALES[stored][0] == name
            sources[name] = (name, SCALES[stored][1] if fits else 1.0, True)
            continue
        bare = re.split(r"[./]", name)[-1].strip()
        unit = stored or unit_of(name) or unit_of(bare)
        if units.get(name) and not unit:
            continue  # volts, say: neither a position nor a force, whatever its name
        if unit:
            ours, scale = SCALES[unit]
        else:
            ours = next((o for o, form in NAMES.items() if re.fullmatch(form, bare.lower())), "")
            scale = 1.0
        if ours == "time_s" and np.any(np.diff(values) <= 0.0):
            continue
        if ours == "pressure_pa" and ours in sources:
            ours = "pressure_2_pa"
        if ours and ours not in sources:
            sources[ours] = (name, scale, bool(unit))
    return sources


def draft(folder: Path, files: Sequence[Path], force: bool = False) -> list[str]:
    """Copy files into a folder with a draft of campaign.toml and a picture of the channels.

    Returns what the files do not say, as questions. Raises InputError for a file that cannot be
    read, for files whose columns differ, for two of the same name and, without `force`, where the
    folder has another file of that name.
    """
    names = [file.name for file in files]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InputError(f"{files[number]}: a second file {name}; expected different names")
    tables = [read_columns(file) for file in files]
    for file in files:
        copy = folder / file.name
        if copy.exists() and not force and not file.samefile(copy):
            raise InputError(f"{copy}: exists, and is not {file}; expected none, or --force")
    columns, _dialect, units = tables[0]
    shown = {f"{name} [{units[name]}]" if name in units else name for name in columns}
    for file, (other, _, others) in zip(files, tables, strict=True):
        described = {f"{name} [{others[name]}]" if name in others else name for name in other}
        if described != shown:
            odd = ", ".join(sorted(described ^ shown))
            raise InputError(f"{file}: other columns than {files[0]}: {odd}; expected the same")
    odd_ones = {
        name
        for table, *_rest in tables
        for name, values in table.items()
        if not np.all(np.abs(values) < LARGEST)
    }
    columns = {name: values for name, values in columns.items() if name not in odd_ones}
    sources = guess(columns, units)
    if not set(columns) - {sources.get("time_s", ("",))[0]}:
        raise InputError(f"{files[0]}: no channel but time; expected position and force")
    asked = [text for name, text in ASKED.items() if not _has(sources, name)]
    asked += ALWAYS + (PRESSURE if "pressure_pa" in sources else ())
    vague = [source for source, _scale, stated in sources.values() if not stated]
    if vague:
        asked.append(f"no unit is stated for {', '.join(vague)}: SI is assumed")
    rate = []
    if "time_s" in sources:
        name, scale, _stated = sources["time_s"]
        hertz = 1.0 / (scale * float(np.median(np.diff(columns[name]))))
        rate = [f"sample_rate_hz = {float(f'{hertz:.6g}')}"]
    lines = [
        f"name = {toml_value(folder.name)}",
        'rig = "force"',
        *rate,
        "",
        *(f"# {text}" for text in asked),
        "[columns]",
    ]
    for ours, (source, scale, _stated) in sources.items():
        if ours != source or scale != 1.0:
            lines.append(f"{ours} = {{ column = {toml_value(source)}, scale = {scale!r} }}")
    used = {source for source, _scale, _stated in sources.values()}
    lines += [f"# not used: {toml_value(name)}" for name in columns if name not in used]
    lines += [f"# not used, not finite: {toml_value(name)}" for name in sorted(odd_ones)]
    for file, (_columns, dialect, _units) in zip(files, tables, strict=True):
        lines += ["", "[[stroke]]", f"file = {toml_value(file.name)}"]
        lines += [f"# read as {dialect}"] if dialect else []
        if not (folder / file.name).exists() or not file.samefile(folder / file.name):
            shutil.copyfile(file, folder / file.name)
    write_atomically(folder / "campaign.toml", "\n".join(lines) + "\n")
    drawn = [{name: table[name] for name in columns} for table, *_rest in tables]
    save(_figure(files, drawn, sources), folder, "channels")
    return asked


def _has(sources: Mapping[str, object], name: str) -> bool:
    others = {"position_m": ("angle_rad",), "force_n": ("torque_n_m",)}
    return name in sources or any(other in sources for other in others.get(name, ()))


def _figure(
    files: Sequence[Path],
    tables: Sequence[Mapping[str, Floats]],
    sources: Mapping[str, tuple[str, float, bool]],
) -> Figure:
    """Return every channel as it is in the files, one stack a file (of the first four)."""
    stacks = []
    clock = sources.get("time_s", ("", 1.0, False))
    ours = {source: name for name, (source, _scale, _stated) in sources.items()}
    for file, columns in list(zip(files, tables, strict=True))[:4]:
        count = len(next(iter(columns.values())))
        x = np.asarray(columns.get(clock[0], np.arange(float(count))) * clock[1])
        rows = np.linspace(0, count - 1, min(count, 4000)).astype(int)
        panels = [
            Panel(
                f"{name}: {ours.get(name, 'not used')}",
                "",
                [Series(name, x[rows], values[rows], "measured")],
                height=110,
            )
            for name, values in columns.items()
            if name != clock[0]
        ]
        axis = "time, s" if clock[0] else "row"
        stacks.append(Stack(f"{axis} ({file.name})", panels))
    return Figure(stacks)
