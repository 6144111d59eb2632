"""What the signals of a truck's log stand for: a mapping file, and the DBC that its names are of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

import msgspec
from msgspec import Meta

from can_dbc import typed_toml
from can_dbc.errors import InputError, unknown_name
from can_dbc.frame import split_id

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

SHIPPED: Final = Path(__file__).with_name("j1939.toml")
LAYOUT: Final = Path(__file__).with_name("j1939.dbc")
ANY_SOURCE: Final = 0xFE
"""The null address: as source in a DBC's identifier it means whoever sends the message."""

Meaning = Literal[
    "shift_in_process",
    "current_gear",
    "selected_gear",
    "input_shaft_rad_s",
    "output_shaft_rad_s",
    "engine_rad_s",
    "engine_torque_share",
    "supply_pressure_pa",
    "duty_b",
    "duty_n",
    "duty_f",
    "pulse_s",
    "coil_temperature_k",
]


class MappedSignal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A row of a mapping file: value in the meaning's unit = scale * value in the DBC's + offset."""

    meaning: Meaning
    message: str
    signal: str
    scale: float = 1.0
    offset: float = 0.0
    source: Annotated[int, Meta(ge=0, le=0xFD)] | None = None


class Gearbox(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What lies between the synchronizer on the main shaft and the output shaft: a range section.

    range_ratio: main shaft by output speed in the low range, 1 without a range section.
    low_range_above: input by output speed from which on the low range is engaged.
    """

    range_ratio: Annotated[float, Meta(ge=1.0, le=10.0)] = 3.75
    low_range_above: Annotated[float, Meta(gt=0.0, le=100.0)] = 3.4

    def main_shaft_by_output(self, ratio: float) -> float:
        """Return main shaft by output speed in a gear with this input by output speed."""
        return self.range_ratio if ratio > self.low_range_above else 1.0


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    signal: Annotated[list[MappedSignal], Meta(min_length=1)]
    gearbox: Gearbox = Gearbox()


class Sender(NamedTuple):
    """Who sends a mapped message; `source` is `ANY_SOURCE` for an 11-bit identifier."""

    message: str
    channel: str
    source: int


class SignalMapping:
    """The rows of a mapping file, bound to the messages of a DBC.

    J1939 messages are found by their parameter group, whatever the priority; the source address
    counts where the DBC or the row states one. 11-bit identifiers are found as they are.
    """

    def __init__(self, path: str | None = None, dbc: str | None = None) -> None:
        """`path`: mapping file, None for the shipped one; `dbc`: layout, None for SAE J1939-71.

        Raises InputError naming the file and the nearest names for what is unknown.
        """
        from can_dbc.dbc import load_dbc

        self.path = path or SHIPPED.name
        self.dbc = dbc or LAYOUT.name
        self.is_standard = path is None and dbc is None
        file = typed_toml.convert(typed_toml.read_toml(path or SHIPPED), _File, self.path)
        self.rows, self.gearbox = file.signal, file.gearbox
        messages = {message.name: message for message in load_dbc(dbc or LAYOUT).messages}
        self._messages: dict[str, Message] = {}
        self._signals: list[Signal] = []
        for index, row in enumerate(self.rows):
            self._bind(row, f"{self.path}: signal[{index}]", messages)

    def _bind(self, row: MappedSignal, where: str, messages: dict[str, Message]) -> None:
        message = _named(messages, row.message, f"{where}.message", self.dbc)
        signals = {signal.name: signal for signal in message.signals}
        signal = _named(signals, row.signal, f"{where}.signal", f"{message.name} in {self.dbc}")
        if message.length > 64:
            raise InputError(
                f"{where}.message: {message.name} has {message.length} bytes; expected one frame"
            )
        if row.scale == 0.0:
            raise InputError(f"{where}.scale: 0 makes every value the same; expected another")
        self._messages[message.name] = message
        self._signals.append(signal)

    def messages_of(self, *meanings: Meaning) -> list[str]:
        """Return the messages that carry any of the meanings, each once."""
        names = [row.message for row in self.rows if row.meaning in meanings]
        return list(dict.fromkeys(names))

    def length(self, message: str) -> int:
        """Return the bytes of a mapped message."""
        return int(self._messages[message].length)

    def identifier(self, message: str) -> str:
        """Return the parameter group or identifier by which a mapped message is found."""
        layout = self._messages[message]
        if layout.is_extended_frame:
            return f"PGN {split_id(layout.frame_id).pgn}"
        return f"identifier {layout.frame_id:03X}"

    def sender(self, channel: str, can_id: int, extended: bool) -> Sender | None:
        """Return which mapped message the frames of an identifier are, and whose; None for others."""
        theirs = split_id(can_id)
        for name, message in self._messages.items():
            ours = split_id(message.frame_id)
            anyone = ours.source == ANY_SOURCE or message.protocol == "j1939"
            if message.is_extended_frame != extended:
                continue
            if not extended and message.frame_id == can_id:
                return Sender(name, channel, ANY_SOURCE)
            if extended and theirs.pgn == ours.pgn and (anyone or theirs.source == ours.source):
                return Sender(name, channel, theirs.source)
        return None

    def values(self, sender: Sender, data: bytes) -> dict[int, float]:
        """Return the valid values of a message, by the index of their row."""
        message = self._messages[sender.message]
        raw: Any = message.decode(data, decode_choices=False, scaling=False, allow_truncated=True)
        values: dict[int, float] = {}
        for index, (row, signal) in enumerate(zip(self.rows, self._signals, strict=True)):
            if row.message != sender.message or signal.name not in raw:
                continue
            if row.source is not None and row.source != sender.source:
                continue
            value = _physical(signal, raw[signal.name], message.is_extended_frame)
            if value is not None:
                values[index] = row.scale * value + row.offset
        return values


def _physical(signal: Signal, raw: float, is_j1939: bool) -> float | None:
    """Return a value in the DBC's unit, None where it is not valid."""
    whole_bytes = signal.length in (8, 16, 32) and not (signal.is_signed or signal.is_float)
    if is_j1939 and whole_bytes and int(raw) >> signal.length - 8 > 0xFB:
        return None
    value = float(signal.scale) * raw + float(signal.offset)
    low, high = signal.minimum, signal.maximum
    if (low is not None and value < low) or (high is not None and value > high):
        return None
    return value


def _named(entries: Mapping[str, Any], name: str, where: str, place: str) -> Any:
    """Return the entry with a name. Raises InputError with the nearest names."""
    if name not in entries:
        shown = typed_toml.one_line(name, 60)
        raise InputError(f"{where}: {shown!r} is {unknown_name(name, entries)} (of {place})")
    return entries[name]
