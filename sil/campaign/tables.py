"""Tables that laboratories export: delimited text of any dialect, binary files, computed columns.

A text is brought to the campaign format's dialect (comma between cells, dot in numbers) and keeps its
line numbers.
Checked by: tests/unit/sil/campaign/test_tables.py
"""

from __future__ import annotations

import ast
import csv
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file
from sil.campaign.binary_tables import BINARY, Floats, read_binary
from sil.files.quantity import counted

DELIMITERS = {"semicolon": ";", "tab": "\t", "comma": ",", "blank": " "}
NUMBER = re.compile(
    r"[+-]?(\d+([.,]\d*)?|[.,]\d+|\d{1,3}(\.\d{3})+,\d*)([eEdD][+-]?\d+)?|[nN]a[nN]|[+-]?[iI]nf"
)
MOST_BYTES = 4 << 30
"""The largest text that is read."""


TextTable = tuple[list[str], list[str], int, str]
"""A text as lines of numbers in our dialect: names of the columns; lines of cells separated by commas,
with dots in numbers; number of the first of them in the file; dialect in words, empty for our own."""


def _numeric(cell: str) -> bool:
    return NUMBER.fullmatch(cell.strip().strip('"')) is not None


def sniff(path: Path, text: str, encoding: str) -> TextTable:
    """Return a delimited text in our dialect.

    Raises InputError if no row of numbers is found.
    """
    lines = text.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    number, name = next(
        (
            (k, name)
            for text_too in (False, True)
            for k, line in enumerate(lines[:200])
            if (name := _delimiter(line, text_too))
        ),
        (-1, ""),
    )
    if number < 0:
        raise InputError(f"{path}: no rows of numbers; expected a table with a header row")
    sign = DELIMITERS[name]
    while number and _alike(_split(lines[number - 1], sign), _split(lines[number], sign)):
        number -= 1
    comma = any(
        re.search(r"\d,\d", "".join(_split(line, sign)) if sign == "," else line)
        for line in lines[number:]
        if sign != "," or '"' in line
    )
    rows = [_clean(row, sign) for row in lines[number:]]
    width = rows[0].count(",") + 1
    header, units = [f"column_{k + 1}" for k in range(width)], ""
    for above in reversed(lines[:number]):
        cells = [cell.strip() for cell in _split(above.lstrip("#% "), sign)]
        if len(cells) != width:
            continue
        if units == "" and number > 1 and all(_is_unit(cell) for cell in cells):
            units = "units in a row of their own"
            header = cells
            continue
        if units:
            cells = [
                f"{c} [{u.strip('[]()')}]" if u else c for c, u in zip(cells, header, strict=True)
            ]
        header = cells
        break
    features = [
        "" if name == "comma" else f"{name}-separated",
        "decimal comma" if comma else "",
        encoding,
        "quoted header" if number and '"' in lines[number - 1] else "",
        units,
        "" if number else "no header row",
        f"{counted(number - 1, 'line')} above the header" if number > 1 + bool(units) else "",
    ]
    return header, rows, number + 1, ", ".join(filter(None, features))


def _delimiter(line: str, text_too: bool) -> str:
    """Return the name of the delimiter of a row of numbers, with cells of text too; empty if none."""
    for name, sign in DELIMITERS.items():
        filled = [cell for cell in _split(line, sign) if cell.strip()]
        numbers = sum(map(_numeric, filled))
        if numbers >= 2 and (text_too or numbers == len(filled)):
            return name
    return ""


def _alike(above: list[str], row: list[str]) -> bool:
    """Return whether the cells of a line are numbers where those of a row of numbers are."""
    cells = [
        cell for cell, below in zip(above, row, strict=False) if _numeric(below) and cell.strip()
    ]
    return len(above) == len(row) and bool(cells) and all(map(_numeric, cells))


def _split(line: str, sign: str) -> list[str]:
    if sign == " ":
        return line.split()
    if '"' not in line:
        return line.split(sign)
    return next(csv.reader([line], delimiter=sign, skipinitialspace=True), [])


def _clean(line: str, sign: str) -> str:
    if sign == "," and '"' not in line:
        return line
    cells = _split(line, sign)
    if "," in line:
        cells = [
            re.sub(r"(?<=\d)\.(?=\d{3}(\.\d{3})*,)", "", cell).replace(",", ".") for cell in cells
        ]
    return ",".join(cells)


def _is_unit(cell: str) -> bool:
    return cell == "" or cell.strip("[]() ") in SCALES or cell.strip("[]() ") in ("-", "1")


UNITS = {
    "time_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "sec": 1.0},
    "position_m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "µm": 1e-6, "um": 1e-6, "in": 0.0254},
    "force_n": {"N": 1.0, "kN": 1e3, "lbf": 4.4482216, "kgf": 9.80665},
    "pressure_pa": {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "bar": 1e5, "MPa": 1e6}
    | {"psi": 6894.757},
    "angle_rad": {"rad": 1.0, "deg": np.pi / 180.0, "°": np.pi / 180.0},
    "torque_n_m": {"Nm": 1.0, "N m": 1.0, "N·m": 1.0, "mNm": 1e-3},
}
SCALES = {unit: (ours, scale) for ours, table in UNITS.items() for unit, scale in table.items()}
"""Our column and the factor to its unit, by unit."""


def read_columns(path: Path) -> tuple[dict[str, Floats], str, dict[str, str]]:
    """Return the columns [n] of a file by its own names, its dialect in words, and stored units.

    The columns are in the file's units; a text has none but those in its names.

    Raises InputError with the line of what is wrong.
    """
    if path.suffix.lower() in BINARY:
        return read_binary(path)
    header, body, first, dialect = read_text(path)
    notes: list[str] = []
    try:
        table = parse_cells(path, body, len(header), first)
        columns = dict(zip(header, table.T, strict=True))
    except InputError:
        columns, notes = _converted(header, body)
        if not notes:
            raise
    named = [name for name in header if name]
    if twice := [name for name in named if named.count(name) > 1]:
        what = f"column {twice[0]!r} twice; expected each name once"
        raise InputError(f"{path}: line {first - 1}: {what}")
    count = len(next(iter(columns.values()), ()))
    if count < 2:
        raise InputError(f"{path}: {counted(count, 'sample')}; expected at least 2")
    return columns, ", ".join(filter(None, (dialect, *notes))), {}


def read_text(path: Path) -> TextTable:
    """Return header, lines of cells, number of the first line, and the dialect of a delimited text.

    Raises InputError for a file that cannot be read, or that holds no table.
    """
    raw = read_user_file(path, "a table with a header row", MOST_BYTES)
    text, encoding = _decoded(raw)
    lines = text.splitlines()
    if not lines or not lines[0].strip():
        raise InputError(f"{path}: line 1: empty; expected a header row")
    foreign = encoding or set(lines[0]) & set(";\t#%") or "," not in lines[0] or '"' in text
    if len(lines) > 1 and lines[1].strip():
        foreign = foreign or not any(map(_numeric, lines[1].split(",")))
    if not foreign and not _numeric(lines[0].split(",")[0]):
        header = [name.strip() for name in lines[0].split(",")]
        body = lines[1:]
        if not raw.endswith(b"\n") and body and len(body[-1].split(",")) != len(header):
            raise InputError(
                f"{path}: line {len(lines)}: torn: {len(body[-1].split(','))} cells, "
                f"expected {len(header)}"
            )
        return header, body, 2, ""
    return sniff(path, text, encoding)


def parse_cells(path: Path, body: Sequence[str], width: int, first: int = 2) -> Floats:
    """Rows of numbers as an array; the slow path runs only to name the line that is wrong.

    Result [rows, width], in the units of the file. first: line of the first row. Raises InputError
    naming the line.
    """
    try:
        table = np.loadtxt(body, delimiter=",", ndmin=2) if body else np.zeros((0, width))
        if table.shape[1] == width and np.all(np.isfinite(table)):
            return table
    except ValueError:
        pass
    for number, row in enumerate(body, start=first):
        cells = row.split(",")
        if len(cells) != width:
            raise InputError(f"{path}: line {number}: {len(cells)} cells, expected {width}")
        for cell in cells:
            try:
                value = float(cell)
            except ValueError:
                raise InputError(
                    f"{path}: line {number}: {cell.strip()[:30]!r} is not a number; expected one"
                ) from None
            if not math.isfinite(value):
                raise InputError(
                    f"{path}: line {number}: {cell.strip()!r} is not finite; expected a number"
                )
    raise InputError(f"{path}: no rows of numbers; expected {width} columns")


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


def _converted(header: list[str], lines: list[str]) -> tuple[dict[str, Floats], list[str]]:
    """Return columns [n] of lines with cells that are no numbers, and what was done; none if unclear.

    Stamps with date and time of day become seconds. Columns of text or without values are left out. A slower channel, with
    values in every k-th row only, is interpolated between them.
    """
    cells = [line.split(",") for line in lines if line.strip()]
    if any(len(row) != len(header) for row in cells):
        return {}, []
    channels: dict[str, Floats] = {}
    left_out, notes = [], []
    for name, column in zip(header, np.char.strip(np.array(cells)).T, strict=True):
        rows = np.flatnonzero(column != "")
        if not any(map(_numeric, column)):
            stamps = [stamp for cell in column if (stamp := _stamp(cell)) is not None]
            if not stamps:
                left_out.append(name or "without a name")
                continue
            if len(stamps) < len(column) or len({s.tzinfo is None for s in stamps}) > 1:
                return {}, []
            channels[name] = np.array([(s - stamps[0]).total_seconds() for s in stamps])
            notes.append(f"{name} in seconds from {column[0]}")
            continue
        try:
            values = column[rows].astype(np.float64)
        except ValueError:
            return {}, []
        steps = np.diff(rows)
        if len(rows) < len(column):
            if len(rows) < 10 or steps.min() < 2 or steps.max() > 2 * np.median(steps):
                return {}, []
            notes.append(f"{name} interpolated from a slower rate")
        channels[name] = np.interp(np.arange(len(column)), rows, values)
    if left_out:
        notes.append(f"columns without numbers left out: {', '.join(left_out)}")
    return channels, notes if all(np.all(np.isfinite(v)) for v in channels.values()) else []


def _stamp(cell: str) -> datetime | None:
    """Return a date with its time of day, None for any other text."""
    try:
        return datetime.fromisoformat(cell) if ":" in cell else None
    except ValueError:
        return None


# --- columns computed from others -------------------------------------------------------------
OPERATIONS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


def formula(text: str, columns: Mapping[str, Floats]) -> Floats:
    """Return a column [n] computed from others: numbers, + - * / **, names; quoted if not plain.

    `row` counts the rows from 0. Raises KeyError for a name that is no column, ValueError for what
    is no formula.
    """
    count = len(next(iter(columns.values())))

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Expression():
                return value(node.body)
            case ast.BinOp():
                return OPERATIONS[type(node.op)](value(node.left), value(node.right))
            case ast.UnaryOp():
                return OPERATIONS[type(node.op)](value(node.operand))
            case ast.Constant(value=int() | float() as number):
                return float(number)
            case ast.Constant(value=str() as name) | ast.Name(id=name):
                return np.arange(count, dtype=np.float64) if name == "row" else columns[name]
        raise ValueError(text)

    try:
        tree = ast.parse(text, mode="eval")
        with np.errstate(all="ignore"):
            result = np.asarray(value(tree), dtype=np.float64)
    except (SyntaxError, TypeError, ArithmeticError) as error:
        raise ValueError(text) from error
    return np.array(np.broadcast_to(result, count))
