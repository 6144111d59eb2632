"""Databases of other people, read through cantools.

cantools declares no exceptions and expands some ranges without end: impossible numbers are refused first, its errors
become one line.
"""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, NoReturn

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file

if TYPE_CHECKING:
    from cantools.database import Database


def load_dbc(
    path: str | os.PathLike[str], strict: bool = True, most_bytes: int = 64 << 20
) -> Database:
    """Read a DBC file, in UTF-8 or else in Windows-1252; `strict` refuses signals that overlap or leave their message.

    Raises InputError with file, line (where it is known) and reason for all that is wrong.
    """
    source = os.fspath(path)
    return parse_dbc(read_user_file(source, "a DBC file", most_bytes), source, strict)


def parse_dbc(content: bytes, source: str = "DBC", strict: bool = True) -> Database:
    """Read the bytes of a DBC file as `load_dbc` does; `source` is its name in messages."""
    from cantools.database.can import Database

    text = _Text(source, _decoded(content, source))
    _refuse_impossible(text)
    database = Database(strict=strict)
    try:
        database.add_dbc_string(text.text)
    except Exception as error:  # whatever cantools raises is the file's fault
        text.refuse(_offset_of(error, text.text), _reason(error))
    _refuse_unusable(database, text)
    return database


class _Text:
    """A file's text and name."""

    def __init__(self, source: str, text: str) -> None:
        self.source = source
        self.text = text

    def refuse(self, offset: int | None, what: str) -> NoReturn:
        """Raise the InputError for the line at an offset, or for the file as a whole."""
        line = "" if offset is None else f" line {self.text.count(chr(10), 0, offset) + 1}:"
        raise InputError(f"{self.source}:{line} {what}")


def _decoded(content: bytes, source: str) -> str:
    if b"\0" in content:
        raise InputError(f"{source}: holds zero bytes; expected the text of a DBC file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        pass  # not UTF-8, so the encoding that the DBC format grew up with
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start]
        raise InputError(
            f"{source}: line {line}: byte {byte:#04x}; expected text in UTF-8 or Windows-1252"
        ) from None


def _refuse_impossible(text: _Text) -> None:
    """Refuse what cantools would expand without end, or overwrite or misread silently."""
    # as cantools splits the text: comments to the end of the line, strings with \" inside
    unread = r'//.*\n|"(?:\\"|[^"])*?"'
    code = re.sub(unread, lambda match: re.sub(r"[^\n]", " ", match.group()), text.text)
    _refuse_huge_powers(text, code)
    longest_message = 1785  # bytes of a J1939 transport protocol message
    names: set[str] = set()
    identifiers: dict[str, str] = {}
    for match in re.finditer(r"\bBO_\s+[-+]?(\d+)\s+(\w+)\s*:\s*[-+]?(\d+)", code):
        identifier, name, length = match.group(1).lstrip("0"), match.group(2), match.group(3)
        if name in names:
            text.refuse(match.start(), f"message {name} is declared twice")
        if identifier in identifiers:
            other = identifiers[identifier]
            text.refuse(match.start(), f"messages {other} and {name} share an identifier")
        names.add(name)
        identifiers[identifier] = name
        if _above(length, longest_message):
            what = f"message {name} has {length[:20]} bytes; expected at most {longest_message}"
            text.refuse(match.start(), what)
    for match in re.finditer(r"\bSG_\s+(\w+)[^:;]*:([^:;|]*)\|([^:;@]*)@\s*(\S?)", code):
        name, start, length, order = match.groups()
        if order not in ("0", "1"):
            what = f"signal {name} has byte order {order!r}; expected 0 (big-endian) or 1 (little-endian)"
            text.refuse(match.start(), what)
        for number in (re.sub(r"\D", "", start), re.sub(r"\D", "", length)):
            if _above(number, 8 * longest_message):
                limit = f"expected at most {8 * longest_message}"
                text.refuse(match.start(), f"signal {name} reaches bit {number[:20]}; {limit}")
    for statement in re.finditer(r"\bSG_MUL_VAL_\b[^;]*", code):
        values = 0
        for match in re.finditer(r"(\d+)\s*-\s*(\d+)", statement.group()):
            low, high = match.groups()
            huge = _above(high, 1 << 63) or _above(low, 1 << 63)
            values += 0 if huge else max(0, int(high) - int(low) + 1)
            if huge or values > 4096:
                limit = "expected at most 4096 values of a signal"
                offset = statement.start() + match.start()
                text.refuse(offset, f"multiplexer range {low[:20]}-{high[:20]}; {limit}")


def _refuse_huge_powers(text: _Text, code: str) -> None:
    """Refuse powers of ten that would take for ever, or all memory, as whole numbers."""
    largest_power = 400
    # a word never starts with a digit, since the number before it is taken first
    for match in re.finditer(r"[A-Za-z_]\w*|(?<!\d)\d++\.?+\d*+[eE][+-]?(\d+)", code):
        if match.group(1) and _above(match.group(1), largest_power):
            text.refuse(match.start(), f"number {match.group()[:40]} has no use")
    texts = set(re.findall(r'\bBA_DEF_\w*\s+(?:\w+\s+)?"([^"]*)"\s+STRING\b', text.text))
    value_of = re.compile(r'\bBA_\w*\s+"([^"]*)"[^";]*\Z')
    for match in re.finditer(r'"\s*[-+]?\d[\d_.]*[eE][+-]?(\d[\d_]*)\s*"', text.text):
        if _above(match.group(1).replace("_", ""), largest_power):
            attribute = value_of.search(text.text, 0, match.start())
            if attribute and attribute.group(1) not in texts:
                text.refuse(match.start(), f"number {match.group()[:40]} has no use")


def _above(digits: str, limit: int) -> bool:
    digits = digits.lstrip("0")
    return len(digits) > 20 or int(digits or "0") > limit


def _offset_of(error: Exception, text: str) -> int | None:
    """Return the offset that an error states, else that of what its message names."""
    offset = getattr(error, "offset", None)
    if isinstance(offset, int):
        return offset
    reason = str(error)
    if isinstance(error, KeyError):  # an attribute that is not defined
        sought = rf'^[ \t]*BA_\w*\s+"{re.escape(str(error.args[0]))}"'
    elif unused := re.search(r"VAL_ (\d+) (\w+)", reason):
        sought = rf"^[ \t]*VAL_\s+{unused.group(1)}\s+{unused.group(2)}\b"
    elif message := re.search(r"in message (\w+)", reason):
        sought = rf"^[ \t]*BO_\s+\d+\s+{message.group(1)}\b"
        if signal := re.search(r"signals? (\w+)", reason):
            sought += rf"[^;]*?\n[ \t]*(?=SG_\s+{signal.group(1)}\b)"
    else:
        return None
    place = re.search(sought, text, re.MULTILINE)
    return None if place is None else max(place.start(), place.end() - 1)


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split()).removesuffix(".")
    if len(text) > 160:
        text = text[:157] + "..."
    column = getattr(error, "column", None)
    if column is not None:
        return f"column {column}: {text.split(': ', 1)[-1]} is not DBC grammar; expected a DBC file"
    if isinstance(error, KeyError):
        return f"refers to {text}, which is not declared; expected its declaration"
    if type(error).__module__.startswith("cantools"):
        return f"{text}; expected a DBC without contradictions"
    return f"not a DBC that can be understood ({type(error).__name__}: {text})"


def _refuse_unusable(database: Database, text: _Text) -> None:
    """Refuse what cantools accepts although nothing can be done with it."""
    for message in database.messages:
        declared = re.search(rf"\bBO_\s+\d+\s+{re.escape(message.name)}\b", text.text)
        offset = declared.start() if declared else None
        cycle_ms = message.cycle_time
        number = isinstance(cycle_ms, int | float) and 0 <= cycle_ms < 10**12
        if cycle_ms is not None and not number:
            given = f"cycle time {str(cycle_ms)[:30]!r}; expected 0 to 10^12 milliseconds"
            text.refuse(offset, f"message {message.name}: {given}")
        for signal in message.signals:
            where = f"signal {signal.name} of {message.name}"
            scale, shift = signal.conversion.scale, signal.conversion.offset
            if scale == 0:
                text.refuse(offset, f"{where}: factor 0")
            for value in (scale, shift, signal.minimum, signal.maximum):
                if value is not None and not abs(value) <= 1e300:
                    text.refuse(offset, f"{where}: {str(value)[:30]}; expected a finite number")
