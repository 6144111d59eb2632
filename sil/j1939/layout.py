"""The signals of a database's messages, those of messages that contradict themselves one by one.

Checked by: tests/unit/sil/j1939/test_decode.py
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


class Field(NamedTuple):
    """A signal under a name that no other one of its message has; `alone`: a message of only it."""

    name: str
    signal: Signal
    alone: Message | None = None


class MessageLayout:
    """Decodes a message: as a whole, or each signal alone if signals overlap or leave the message.

    problems: what is wrong with it, and which signals are therefore not decoded.
    """

    def __init__(self, message: Message) -> None:
        from cantools.database import Error

        self.message = message
        self.problems: list[str] = []
        try:
            message.refresh(strict=True)
            self.fields = [Field(signal.name, signal) for signal in message.signals]
            return
        except Error as error:
            self.problems.append(f"{' '.join(str(error).split())} Each is decoded alone")
        self.fields = []
        for signal in message.signals:
            name = signal.name
            if name in (field.name for field in self.fields):
                name = f"{name} (bit {signal.start})"
                self.problems.append(
                    f"a second signal {signal.name} of {message.name}: as {name!r}"
                )
            try:
                self.fields.append(Field(name, signal, _alone(message, signal)))
            except Error:
                self.problems.append(
                    f"signal {name} of {message.name} is not decoded: it leaves the message's "
                    f"{message.length} bytes"
                )

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return the raw values in a frame by name; those that it is too short for are missing.

        Raises DecodeError, and others that cantools does not declare.
        """
        how: dict[str, Any] = {"decode_choices": False, "scaling": False, "allow_truncated": True}
        if not self.problems:
            return dict(self.message.decode(data, **how))
        raw: dict[str, Any] = {}
        for field in self.fields:
            assert field.alone is not None
            for value in field.alone.decode(data, **how).values():
                raw[field.name] = value
        return {f.name: raw[f.name] for f in self.fields if f.name in raw and _sent(f.signal, raw)}


def _alone(message: Message, signal: Signal) -> Message:
    """Return a message of one signal. Raises cantools' Error if that does not fit into it."""
    plain = copy.copy(signal)
    plain.multiplexer_ids, plain.multiplexer_signal = None, None
    plain.is_multiplexer = False
    how = {"is_extended_frame": message.is_extended_frame, "strict": True}
    return type(message)(message.frame_id, message.name, message.length, [plain], **how)


def _sent(signal: Signal, raw: Mapping[str, Any]) -> bool:
    """Return whether a multiplexed signal is in a frame with these raw values."""
    ids = signal.multiplexer_ids
    return not ids or raw.get(signal.multiplexer_signal) in ids


def is_unavailable(signal: Signal, raw: Any) -> bool:
    """Return whether a J1939 sender has no value: all bits set (SAE J1939-71).

    The standard defines it for states of two bits and for numbers from four bits on; flags of one bit
    and what the database names are values.
    """
    wide_enough = signal.length == 2 or signal.length >= 4
    named = signal.choices is not None and raw in signal.choices
    return wide_enough and not named and raw == (1 << signal.length) - 1
