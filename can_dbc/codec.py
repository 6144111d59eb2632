"""Strict encoding and decoding of every message of opc4.dbc.

raw = round((physical - offset) / factor), half to even, where physical is the SI value of the
dataclass in the unit of the DBC. Unused bits are 1; a receiver refuses other values except in the
two public J1939 groups, whose unused bits later editions may assign. What a message needs is
looked up in the DBC when it is first used. The counter and CRC of protected messages are left 0
by `encode` and ignored by `decode`: can_dbc.e2e does both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter, index
from typing import Any, NoReturn, get_args, get_type_hints

from can_dbc.contract import MessageSpec, SignalSpec, contract
from can_dbc.errors import CodecError
from can_dbc.frame import Frame, split_id
from can_dbc.messages import SIGNALS, Message

_SI = {
    "": (1.0, 1.0),
    "K": (1.0, 1.0),
    "Pa": (1.0, 1.0),
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
_NOT_AVAILABLE_FROM = {2: 2, 8: 0xFE, 16: 0xFE00}
"""First raw value of a width that means error or not available (SAE J1939-71, 5.1)."""


class _Number:
    """A number, `by` the SI denominator and `to_si` the numerator of its unit."""

    def __init__(self, signal: SignalSpec) -> None:
        self.factor, self.offset = signal.factor, signal.offset
        self.to_si, self.by = _SI[signal.unit]
        self.low = round((signal.minimum - signal.offset) / signal.factor)
        self.high = round((signal.maximum - signal.offset) / signal.factor)
        self.mask = signal.mask
        self.negative_from = signal.mask >> 1 if signal.signed else signal.mask
        limits = (limit * self.to_si / self.by for limit in (signal.minimum, signal.maximum))
        self.expected = "{:g} to {:g}".format(*limits)

    def to_raw(self, value: Any) -> int:
        raw: int = round((value * self.by / self.to_si - self.offset) / self.factor)
        if not self.low <= raw <= self.high:
            raise ValueError
        return raw & self.mask

    def from_raw(self, raw: int) -> float:
        if raw > self.negative_from:
            raw -= self.mask + 1
        if not self.low <= raw <= self.high:
            raise ValueError
        return (raw * self.factor + self.offset) * self.to_si / self.by


class _Whole:
    """A whole number with factor 1."""

    def __init__(self, signal: SignalSpec) -> None:
        self.offset = int(signal.offset)
        self.low = int(signal.minimum) - self.offset
        self.high = int(signal.maximum) - self.offset
        self.expected = f"a whole number from {signal.minimum} to {signal.maximum}"

    def to_raw(self, value: Any) -> int:
        raw = index(value) - self.offset
        if not self.low <= raw <= self.high:
            raise ValueError
        return raw

    def from_raw(self, raw: int) -> int:
        if not self.low <= raw <= self.high:
            raise ValueError
        return raw + self.offset


_TRUTH = {False: 0, True: 1}  # also of numpy


class _Choice:
    """A bool or a member of an enum."""

    def __init__(self, kind: type[int], signal: SignalSpec) -> None:
        self.kind = kind
        last = 1 if kind is bool else int(signal.maximum)  # J1939 has more states of two bits
        self.members = tuple(kind(raw) for raw in range(last + 1))
        self.expected = f"a {kind.__name__}"

    def to_raw(self, value: Any) -> int:
        if self.kind is bool:
            return _TRUTH[value]
        if value.__class__ is not self.kind:
            raise TypeError
        return int(value)

    def from_raw(self, raw: int) -> int:
        return self.members[raw]


class _Text:
    """Two characters, the first in the low byte; 255 is no character."""

    expected = "two characters of codes 0 to 254"

    def to_raw(self, value: Any) -> int:
        first, second = value.encode("latin-1")
        if first == 0xFF or second == 0xFF:
            raise ValueError
        return int(first | second << 8)

    def from_raw(self, raw: int) -> str:
        if raw & 0xFF == 0xFF or raw >> 8 == 0xFF:
            raise ValueError
        return chr(raw & 0xFF) + chr(raw >> 8)


_Conversion = _Number | _Whole | _Choice | _Text


class _Optional:
    """A J1939 value that may be missing; sent as all ones, received as error or as missing."""

    def __init__(self, inner: _Conversion, signal: SignalSpec) -> None:
        self.inner = inner
        self.mask = signal.mask
        one_value = isinstance(inner, _Text)
        self.missing_from = signal.mask if one_value else _NOT_AVAILABLE_FROM[signal.length]
        self.expected = f"{inner.expected} or None"

    def to_raw(self, value: Any) -> int:
        return self.mask if value is None else self.inner.to_raw(value)

    def from_raw(self, raw: int) -> Any:
        return None if raw >= self.missing_from else self.inner.from_raw(raw)


def _conversion(hint: Any, signal: SignalSpec) -> _Conversion | _Optional:
    """Return the conversion between a field of that type and its signal."""
    if type(None) in get_args(hint):
        inner = _conversion(get_args(hint)[0], signal)
        assert not isinstance(inner, _Optional)
        return _Optional(inner, signal)
    if hint is str:
        return _Text()
    if hint is int:
        return _Whole(signal)
    if hint is float:
        return _Number(signal)
    return _Choice(hint, signal)


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
            field: _conversion(hint, signals[field]) for field, hint in hints.items()
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
    """Return the entry of opc4.dbc for a message type: identifier, timing, signals, comments."""
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


class _Encoders(dict[type, Callable[[Any], Frame]]):
    """Encoder per message type, made when first asked for."""

    def __missing__(self, message_type: type) -> Callable[[Any], Frame]:
        if message_type not in SIGNALS:
            raise CodecError(
                f"opc4.dbc: {message_type.__name__} is not a message; expected one of "
                + ", ".join(known.__name__ for known in SIGNALS)
            )
        self[message_type] = encoder = _codec(message_type).encode
        return encoder


class _Decoders(dict[int, Callable[[bytes], Any]]):
    """Decoder per identifier, made when first asked for."""

    def __missing__(self, can_id: int) -> Callable[[bytes], Any]:
        message_type = message_type_of(can_id)
        if message_type is None:
            raise CodecError(f"opc4.dbc: identifier {can_id:#010x} carries no message")
        # messages do not change, so those that come again are decoded once
        self[can_id] = decoder = lru_cache(maxsize=4096)(_codec(message_type).decode)
        return decoder


_codec = cache(_MessageCodec)
_encoders = _Encoders()
_decoders = _Decoders()


def encode(message: Message) -> Frame:
    """Return the frame of a message, rounded half to even to the resolution of the DBC.

    Parameters
    ----------
    message
        One of the classes in `can_dbc.messages`, in SI units.

    Returns
    -------
    Frame
        29-bit identifier and data; counter and CRC of protected messages are 0.

    Raises
    ------
    CodecError
        If a value is out of range, NaN or of another type; the message names the field.
    """
    return _encoders[message.__class__](message)


def decode(frame: Frame) -> Message:
    """Return the message in a frame; the inverse of `encode` on the grid of the DBC.

    Parameters
    ----------
    frame
        Frame as it arrived; counter and CRC are not checked here.

    Returns
    -------
    Message
        The message in SI units.

    Raises
    ------
    CodecError
        If the identifier is unknown, the length wrong, a value without meaning, or an unused bit 0.
    """
    message: Message = _decoders[frame[0]](frame[1])
    return message
