"""Tables that laboratories export: delimited text of any dialect, and binary files.

Delimiter and decimal sign are decided once for a file, from all of it; what is undecidable is asked.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file
from sil.campaign.binary_tables import BINARY, Floats, read_binary
from sil.campaign.units import is_unit
from sil.files.quantity import counted

Decimal = Literal[".", ","]
DELIMITERS = {"semicolon": ";", "tab": "\t", "comma": ",", "blank": " "}


def _style(decimal: str, group: str) -> re.Pattern[str]:
    grouped = rf"[1-9]\d{{0,2}}({group}\d{{3}})+({decimal}\d*)?"
    plain = rf"(\d+({decimal}\d*)?|{decimal}\d+)([eEdD][+-]?\d+)?"
    return re.compile(rf"[+-]?({grouped}|{plain})|[nN]a[nN]|[+-]?[iI]nf")


NUMBER_STYLES: dict[Decimal, re.Pattern[str]] = {".": _style(r"\.", ","), ",": _style(",", r"\.")}
"""Numbers with this decimal sign, the other one between thousands."""


class Undecided(InputError):
    """All numbers of a file may be read with a decimal dot or a decimal comma."""


class _Layout(NamedTuple):
    """Where the table of a text is: names of the columns, index of the first row, and what is said."""

    names: list[str]
    first: int
    delimiter: str
    notes: list[str]


def read_columns(
    path: Path, decimal: Decimal | None = None
) -> tuple[dict[str, Floats], str, dict[str, str]]:
    """Return the columns [n] of a file by its own names and in its units, its dialect in words, and units.

    decimal: the sign, where a text does not show it. Raises InputError with the line of what is wrong,
    `Undecided` if the decimal sign is not known.
    """
    if path.suffix.lower() in BINARY:
        return read_binary(path)
    raw = read_user_file(path, "a table with a header row", 4 << 30)
    text, encoding = _decoded(raw)
    lines = text.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise InputError(f"{path}: line 1: empty; expected a header row")
    layout = _layout(path, lines)
    sign = DELIMITERS[layout.delimiter]
    rows = [[cell.strip() for cell in _split(line, sign)] for line in lines[layout.first :]]
    if all(len(row) == len(layout.names) + 1 and not row[-1] for row in rows):
        rows = [row[:-1] for row in rows]  # each ends in a delimiter, the header does not
    _check_widths(path, rows, layout, whole=raw.endswith((b"\n", b"\r")))
    decimal = _decimal_of(path, rows, layout, decimal)
    columns, notes = _columns(path, rows, layout, decimal)
    count = len(next(iter(columns.values()), ()))
    if count < 2:
        raise InputError(f"{path}: {counted(count, 'sample')}; expected at least 2")
    separated = "" if layout.delimiter == "comma" else f"{layout.delimiter}-separated"
    comma = "decimal comma" if decimal == "," else ""
    words = (separated, comma, encoding, *layout.notes, *notes)
    return columns, ", ".join(filter(None, words)), {}


def _decoded(raw: bytes) -> tuple[str, str]:
    """Return a text and its encoding in words, empty for ASCII."""
    for mark, name, words in (
        (b"\xef\xbb\xbf", "utf-8-sig", "UTF-8 with byte order mark"),
        (b"\xff\xfe", "utf-16", "UTF-16"),
        (b"\xfe\xff", "utf-16", "UTF-16"),
    ):
        if raw.startswith(mark):
            return raw.decode(name, errors="replace"), words
    for name, words in (("ascii", ""), ("utf-8", "UTF-8")):
        try:
            return raw.decode(name), words
        except UnicodeDecodeError:
            pass
    return raw.decode("latin-1"), "Latin-1"


def _numeric(cell: str) -> bool:
    return any(style.fullmatch(cell) for style in NUMBER_STYLES.values())


def _split(line: str, sign: str) -> list[str]:
    if sign == " ":
        return line.split()
    if '"' not in line:
        return line.split(sign)
    return next(csv.reader([line], delimiter=sign, skipinitialspace=True), [])


def _layout(path: Path, lines: Sequence[str]) -> _Layout:
    """Find the rows of numbers and the names above them. Raises InputError for other rows, and for none."""
    delimiters = (
        (k, _delimiter(line, text_too))
        for text_too in (False, True)
        for k, line in enumerate(lines[:200])
    )
    first, name = next(filter(itemgetter(1), delimiters), (-1, ""))
    if first < 0:
        raise InputError(f"{path}: no rows of numbers; expected a table with a header row")
    sign = DELIMITERS[name]
    width = len(_split(lines[first], sign))
    above = [[c.strip() for c in _split(line.lstrip("#% "), sign)] for line in lines[:first]]
    if first and len(above[-1]) == width - 1 and not _split(lines[first], sign)[-1].strip():
        width -= 1
    same = [k for k, cells in enumerate(above) if len(cells) == width]
    # rows of the table above the first one in which every cell is a number
    while same and same[-1] == first - 1 and any(map(_numeric, above[first - 1])):
        if _is_units(above[first - 1]) or len(same) == 1:
            break
        first -= 1
        same.pop()
    if not same and first and len(above[first - 1]) > 1 and name != "blank":
        expected = f"{len(above[first - 1])} as in the line above"
        raise InputError(f"{path}: line {first + 1}: {width} cells, expected {expected}")
    if not same:
        return _Layout([f"column_{k + 1}" for k in range(width)], first, name, ["no header row"])
    names, header, notes = same[-1], above[same[-1]], []
    if len(same) > 1 and _has_units(header, above[same[-2]]):
        names, notes = same[-2], ["units in a row of their own"]
        pairs = zip(above[names], (unit.strip("[]() ") for unit in header), strict=True)
        header = [f"{name} [{unit}]" if unit else name for name, unit in pairs]
    if '"' in lines[names]:
        notes.append("quoted header")
    if names:
        notes.append(f"{counted(names, 'line')} above the header")
    named = [name for name in header if name]
    if twice := [name for name in named if named.count(name) > 1]:
        what = f"column {twice[0]!r} twice; expected each name once"
        raise InputError(f"{path}: line {names + 1}: {what}")
    return _Layout(header, first, name, notes)


def _delimiter(line: str, text_too: bool) -> str:
    """Return the name of the delimiter of a row of numbers, with cells of text too; empty if none."""
    for name, sign in DELIMITERS.items():
        filled = [cell for cell in map(str.strip, _split(line, sign)) if cell]
        numbers = sum(map(_numeric, filled))
        stamped = text_too and any(map(_moment, filled))
        if numbers + stamped >= 2 and (text_too or numbers == len(filled)):
            return name
    return ""


def _is_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    bracketed = all(cell[0] in "[(" and cell[-1] in ")]" for cell in filled)
    return bool(filled) and (bracketed or 2 * sum(map(is_unit, filled)) >= len(filled))


def _has_units(cells: Sequence[str], above: Sequence[str]) -> bool:
    """Return whether a row below another one of as many cells holds the units of the names there."""
    if any(map(_numeric, above)) or sum(map(bool, above)) < max(2, sum(map(bool, cells))):
        return False
    filled = [cell for cell in cells if cell]
    return len(set(filled)) < len(filled) or _is_units(cells)


def _check_widths(path: Path, rows: Sequence[Sequence[str]], layout: _Layout, whole: bool) -> None:
    """Refuse rows of another number of cells. Raises InputError with the line."""
    width = len(layout.names)
    for number, row in enumerate(rows, layout.first + 1):
        if len(row) != width:
            torn = "torn: " if number == layout.first + len(rows) and not whole else ""
            raise InputError(f"{path}: line {number}: {torn}{len(row)} cells, expected {width}")


def _decimal_of(
    path: Path, rows: Sequence[Sequence[str]], layout: _Layout, stated: Decimal | None
) -> Decimal:
    """Return the decimal sign of all numbers. Raises InputError for two signs, `Undecided` if all may be either."""
    cells = {cell for row in rows for cell in row if "." in cell or "," in cell}
    dots, commas = (set(filter(NUMBER_STYLES[sign].fullmatch, cells)) for sign in (".", ","))
    proofs: dict[Decimal, set[str]] = {".": dots - commas, ",": commas - dots}

    def first(of: set[str]) -> tuple[int, str]:
        lines = enumerate(rows, layout.first + 1)
        return next((k, cell) for k, row in lines for cell in row if cell in of)

    shown = [sign for sign, proof in proofs.items() if proof]
    if len(shown) == 2 or (stated and set(shown) - {stated}):
        *earlier, (number, cell) = sorted(first(proofs[sign]) for sign in shown)
        one = f"{earlier[0][1]} in line {earlier[0][0]}" if earlier else f"decimal = {stated!r}"
        raise InputError(
            f"{path}: line {number}: {cell!r} has another decimal sign than {one}; expected one in a file"
        )
    if shown or stated:
        return stated or shown[0]
    if cells and layout.delimiter == "comma" and not any("," in cell for cell in cells):
        return "."
    if either := dots & commas:
        number, cell = first(either)
        one, thousand = re.sub("[.,]", ".", cell), re.sub("[.,]", "", cell)
        raise Undecided(
            f"{path}: line {number}: {cell!r} may be {float(one):g} or {thousand}, and no number of the file "
            'tells which; expected decimal = "." or "," in campaign.toml'
        )
    return "."


def _columns(
    path: Path, rows: Sequence[Sequence[str]], layout: _Layout, decimal: Decimal
) -> tuple[dict[str, Floats], list[str]]:
    """Return columns [n] of cells, and what was done. Raises InputError with the line of a wrong cell.

    Stamps with date and time of day become seconds. Columns of text or without values are left out. A
    slower channel, with values in every k-th row only, is interpolated between them.
    """
    columns: dict[str, Floats] = {}
    left_out, notes = [], []
    style, group = NUMBER_STYLES[decimal], "," if decimal == "." else "."
    for name, cells in zip(layout.names, zip(*rows, strict=True), strict=True):
        filled = [k for k, cell in enumerate(cells) if cell]
        others = {cell for cell in set(cells) if not style.fullmatch(cell)}
        if len(others) == len(set(cells)):
            moments = [_moment(cell) for cell in cells]
            if not any(moments):
                left_out.append(name or "without a name")
                continue
            zoned = [None if m is None else m.tzinfo is not None for m in moments]
            usual = max(set(zoned) - {None}, key=zoned.count)
            for k, moment in enumerate(moments):
                if moment is None or zoned[k] != usual:
                    what = f"{cells[k][:30]!r} is not a number; expected a time stamp as those of {name}"
                    raise InputError(f"{path}: line {layout.first + k + 1}: {what}")
            stamps = [moment for moment in moments if moment]
            columns[name] = np.array([(m - stamps[0]).total_seconds() for m in stamps])
            notes.append(f"{name} in seconds from {cells[0]}")
            continue
        plain = _slower(filled, len(cells))
        if plain:
            others.discard("")
        if others:
            k = next(k for k, cell in enumerate(cells) if cell in others)
            what = f"{cells[k][:30]!r} is not a number; expected one"
            raise InputError(f"{path}: line {layout.first + k + 1}: {what}")
        text = "\n".join(cells[k] for k in filled).replace(group, "").replace(decimal, ".")
        values = np.array(text.replace("d", "e").replace("D", "e").split("\n"), dtype=np.float64)
        if not np.all(np.isfinite(values)):
            k = filled[int(np.argmin(np.isfinite(values)))]
            what = f"{cells[k]!r} is not finite; expected a number"
            raise InputError(f"{path}: line {layout.first + k + 1}: {what}")
        if plain:
            notes.append(f"{name} interpolated from a slower rate")
            values = np.interp(np.arange(len(cells)), filled, values)
        columns[name] = values
    if left_out:
        notes.append(f"columns without numbers left out: {', '.join(left_out)}")
    return columns, notes


def _slower(filled: Sequence[int], count: int) -> bool:
    """Return whether the rows with values are those of a slower channel, and no holes."""
    steps = np.diff(filled)
    regular = len(filled) >= 10 and steps.min() >= 2 and steps.max() <= 2 * np.median(steps)
    return bool(regular) and len(filled) < count


def _moment(cell: str) -> datetime | None:
    """Return a date with its time of day, or a time of day, None for any other text."""
    day = re.sub(r"^(\d\d)\.(\d\d)\.(\d{4})", r"\3-\2-\1", cell)
    with suppress(ValueError):
        if ":" in cell:
            return datetime.fromisoformat(day if "-" in day else f"1970-01-01 {day}")
    return None
