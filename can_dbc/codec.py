"""Strict encoding and decoding of every message of opc4.dbc.

raw = round((physical - offset) / factor), half to even, physical being the SI value in the unit of the DBC. Unused bits
are 1; a receiver refuses others except in the two public J1939 groups, whose unused bits later editions may assign.
The counter and CRC of protected messages are 0 from `encode` and ignored by `decode`: can_dbc.e2e does both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter, index
from typing import Any, NamedTuple, NoReturn, get_args, get_type_hints

from can_dbc.contract import MessageSpec, SignalSpec, contract
from can_dbc.errors import CodecError
from can_dbc.frame import Frame, split_id
from can_dbc.messages import SIGNALS, Message

SI_FACTORS = {
    "": (1.0, 1.0),
    "K": (1.0, 1.0),
    "Pa": (1.0, 1.0),
    "kPa": (1e3, 1.0),
    "rad/s": (1.0, 1.0),
    "%": (1.0, 100.0),
    "ms": (1.0, 1e3),
    "mm/s": (1.0, 1e3),
    "us": (1.0, 1e6),
    "um": (1.0, 1e6),
    "rpm": (math.pi, 30.0),
}
"""Unit of the DBC: numerator and denominator that turn its numbers into SI (into 1 for %)."""

_NO_VALUE = (TypeError, ValueError, KeyError, IndexError, OverflowError, AttributeError)


class Conversion(NamedTuple):
    """Both ways between a field and its raw value; each raises one of `_NO_VALUE` for what is not as `expected`."""

    to_raw: Callable[[Any], int]
    from_raw: Callable[[int], Any]
    expected: str


def _number(signal: SignalSpec) -> Conversion:
    factor, offset, mask = signal.factor, signal.offset, signal.mask
    to_si, by = SI_FACTORS[signal.unit]
    low, high = (round((x - offset) / factor) for x in (signal.minimum, signal.maximum))
    negative_from = mask >> 1 if signal.signed else mask

    def to_raw(value: Any) -> int:
        raw: int = round((value * by / to_si - offset) / factor)
        if not low <= raw <= high:
            raise ValueError
        return raw & mask

    def from_raw(raw: int) -> float:
        if raw > negative_from:
            raw -= mask + 1
        if not low <= raw <= high:
            raise ValueError
        return (raw * factor + offset) * to_si / by

    limits = (limit * to_si / by for limit in (signal.minimum, signal.maximum))
    return Conversion(to_raw, from_raw, "{:g} to {:g}".format(*limits))


def _whole(signal: SignalSpec) -> Conversion:
    """Return the conversion of a whole number with factor 1."""
    offset = int(signal.offset)
    low, high = int(signal.minimum), int(signal.maximum)

    def to_raw(value: Any) -> int:
        if not low <= index(value) <= high:
            raise ValueError
        return index(value) - offset

    def from_raw(raw: int) -> int:
        if not low <= raw + offset <= high:
            raise ValueError
        return raw + offset

    expected = f"a whole number from {signal.minimum} to {signal.maximum}"
    return Conversion(to_raw, from_raw, expected)


def _choice(kind: type[int], signal: SignalSpec) -> Conversion:
    """Return the conversion of a bool or a member of an enum."""
    last = 1 if kind is bool else int(signal.maximum)  # J1939 has more states of two bits

    def member_to_raw(value: Any) -> int:
        if value.__class__ is not kind:
            raise TypeError
        return int(value)

    to_raw = {False: 0, True: 1}.__getitem__ if kind is bool else member_to_raw  # also of numpy
    from_raw = tuple(kind(raw) for raw in range(last + 1)).__getitem__
    return Conversion(to_raw, from_raw, f"a {kind.__name__}")


def _text_to_raw(value: Any) -> int:
    first, second = value.encode("latin-1")
    if first == 0xFF or second == 0xFF:
        raise ValueError
    return int(first | second << 8)


def _text_from_raw(raw: int) -> str:
    if raw & 0xFF == 0xFF or raw >> 8 == 0xFF:
        raise ValueError
    return chr(raw & 0xFF) + chr(raw >> 8)


_TEXT = Conversion(_text_to_raw, _text_from_raw, "two characters of codes 0 to 254")
"""Two characters, the first in the low byte; 255 is no character."""


def missing_from(is_text: bool, signal: SignalSpec) -> int:
    """Return the first raw value that means error or not available (SAE J1939-71, 5.1)."""
    return signal.mask if is_text else {2: 2, 8: 0xFE, 16: 0xFE00}[signal.length]


def _optional(inner: Conversion, signal: SignalSpec) -> Conversion:
    """Return that of a J1939 value or None: sent as all ones, received as error or as missing."""
    first_missing = missing_from(inner is _TEXT, signal)

    def to_raw(value: Any) -> int:
        return signal.mask if value is None else inner.to_raw(value)

    def from_raw(raw: int) -> Any:
        return None if raw >= first_missing else inner.from_raw(raw)

    return Conversion(to_raw, from_raw, f"{inner.expected} or None")


def conversion_of(hint: Any, signal: SignalSpec) -> Conversion:
    """Return the conversion between a field of that type and its signal."""
    if type(None) in get_args(hint):
        return _optional(conversion_of(get_args(hint)[0], signal), signal)
    if hint is str:
        return _TEXT
    if hint is int:
        return _whole(signal)
    return _number(signal) if hint is float else _choice(hint, signal)


class _MessageCodec:
    """Both directions of one message type."""

    def __init__(self, message_type: type) -> None:
        spec = spec_of(message_type)
        hints = get_type_hints(message_type)
        names = SIGNALS[message_type]
        signals = {field: spec.signal(name) for field, name in zip(hints, names, strict=True)}
        self.message_type = message_type
        self.can_id = spec.can_id
        self.length = spec.length
        self.conversions = {
            field: conversion_of(hint, signals[field]) for field, hint in hints.items()
        }
        self.values = attrgetter(*hints)
        self.single = len(hints) == 1
        self.writers = tuple((self.conversions[f].to_raw, signals[f].start) for f in hints)
        self.readers = tuple(
            (self.conversions[f].from_raw, signals[f].start, signals[f].mask) for f in hints
        )
        used = sum(signal.mask << signal.start for signal in spec.signals)
        self.unused = ((1 << 8 * spec.length) - 1) ^ used
        proprietary = split_id(spec.can_id).pgn & 0xFF00 == 0xFF00
        self.checked = self.unused if proprietary else 0

        # values that come again are encoded once; equal ones of other types are not the same
        self.framed = lru_cache(maxsize=4096, typed=True)(self.frame_of)

    def encode(self, message: Any) -> Frame:
        values = self.values(message)
        try:
            return self.framed(values) if self.single else self.framed(*values)
        except _NO_VALUE:
            self.refuse_message(message)

    def frame_of(self, *values: Any) -> Frame:
        word = self.unused
        for value, (to_raw, start) in zip(values, self.writers, strict=True):
            word |= to_raw(value) << start
        return Frame(self.can_id, word.to_bytes(self.length, "little"))

    def decode(self, data: bytes) -> Any:
        word = int.from_bytes(data, "little")
        if len(data) != self.length or word & self.checked != self.checked:
            self.refuse_frame(data)
        try:
            return self.message_type(
                *[from_raw(word >> start & mask) for from_raw, start, mask in self.readers]
            )
        except _NO_VALUE:
            self.refuse_frame(data)

    def refuse_message(self, message: Any) -> NoReturn:
        """Name the first field that cannot be sent."""
        for name, conversion in self.conversions.items():
            value = getattr(message, name)
            try:
                conversion.to_raw(value)
            except _NO_VALUE:
                raise CodecError(
                    f"opc4.dbc: {self.message_type.__name__}.{name}: {value!r} cannot be sent; "
                    f"expected {conversion.expected}"
                ) from None
        raise AssertionError(f"{message!r} was refused although every field can be sent")

    def refuse_frame(self, data: bytes) -> NoReturn:
        """Name the first thing that keeps the bytes from being a message."""
        where = f"opc4.dbc: {self.message_type.__name__}"
        if len(data) != self.length:
            raise CodecError(f"{where}: {len(data)} bytes; expected {self.length}")
        word = int.from_bytes(data, "little")
        for name, (from_raw, start, mask) in zip(self.conversions, self.readers, strict=True):
            raw = word >> start & mask
            try:
                from_raw(raw)
            except _NO_VALUE:
                expected = self.conversions[name].expected
                raise CodecError(
                    f"{where}.{name}: raw value {raw:#x} has no meaning; expected {expected}"
                ) from None
        raise CodecError(f"{where}: unused bits of {data.hex(' ')} are not all 1; expected 1")


def spec_of(message_type: type) -> MessageSpec:
    """Return the entry of opc4.dbc for a message type: identifier, timing, signals."""
    return contract()[message_type.__name__]


def can_id_of(message_type: type) -> int:
    """Return the 29-bit identifier of a message type."""
    return spec_of(message_type).can_id


@cache
def _types() -> dict[int, type]:
    return {can_id_of(message_type): message_type for message_type in SIGNALS}


def message_type_of(can_id: int) -> type | None:
    """Return the message type that an identifier carries; None outside the contract."""
    return _types().get(can_id)


@cache
def _codec(message_type: type) -> _MessageCodec:
    if message_type not in SIGNALS:
        names = ", ".join(kind.__name__ for kind in SIGNALS)
        raise CodecError(
            f"opc4.dbc: {message_type.__name__} is not a message; expected one of {names}"
        )
    return _MessageCodec(message_type)


@cache
def _decoder(can_id: int) -> Callable[[bytes], Any]:
    message_type = message_type_of(can_id)
    if message_type is None:
        raise CodecError(f"opc4.dbc: identifier {can_id:#010x} carries no message")
    # messages do not change, so those that come again are decoded once
    return lru_cache(maxsize=4096)(_codec(message_type).decode)


def encode(message: Message) -> Frame:
    """Return the frame of a message in SI units, rounded half to even to the resolution of the DBC.

    Counter and CRC of protected messages are 0.
    Raises CodecError, naming the field, for a value that is out of range, NaN or of another type.
    """
    kind: type = message.__class__
    return _codec(kind).encode(message)


def decode(frame: Frame) -> Message:
    """Return the message in a frame, in SI units; counter and CRC are not checked here.

    Raises CodecError for an unknown identifier, a wrong length, a value without meaning, and an unused bit that is 0.
    """
    message: Message = _decoder(frame[0])(frame[1])
    return message
