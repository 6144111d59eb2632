"""The contract in C: enums, and for each message of the control unit its struct, pack and unpack.

The arithmetic is that of `can_dbc.codec`, operation by operation: without contracted products (-ffp-contract=off)
equal bits.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple, get_args, get_type_hints

from can_dbc.codec import SI_FACTORS, conversion_of, missing_from, spec_of
from can_dbc.contract import SignalSpec
from can_dbc.frame import split_id
from can_dbc.messages import SIGNALS, Chamber, Fault, Gear, OverrideMode, ShiftState

NODE = "Opc4"


class _Field(NamedTuple):
    """A field of a message: its name and type in C, its signal, and whether it may be missing."""

    name: str
    hint: Any
    signal: SignalSpec
    optional: bool
    expected: str

    @property
    def limits(self) -> tuple[int, int]:
        """Least and largest raw value of a number or a choice; of a whole number, the value itself."""
        signal = self.signal
        if self.hint is int:
            return int(signal.minimum), int(signal.maximum)
        if self.hint is not float:
            return 0, 1 if self.hint is bool else int(signal.maximum)
        low, high = (
            round((x - signal.offset) / signal.factor) for x in (signal.minimum, signal.maximum)
        )
        return low, high

    @property
    def c_type(self) -> str:
        names = {float: "double", int: "int32_t", bool: "bool", str: "char"}
        return names.get(self.hint) or f"enum opc4_{snake(self.hint.__name__)}"


def snake(name: str) -> str:
    """Return a CamelCase name in lower case with underscores."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def unit_of(name: str) -> str:
    """Return the unit that the end of a name states, '' for none."""
    units = {"rad_s": "rad/s", "s": "s", "k": "K", "m": "m"}
    return next((unit for end, unit in units.items() if name.endswith(f"_{end}")), "")


def messages() -> list[type]:
    """Return the messages that the control unit sends or receives, in the order of the contract."""
    return [kind for kind in SIGNALS if {NODE} & {*spec_of(kind).senders, *spec_of(kind).receivers}]


def header() -> str:
    """Return the part of opc4.h that follows from opc4.dbc and the messages."""
    parts = [_enum(kind) for kind in (Gear, Chamber, ShiftState, Fault, OverrideMode)]
    for kind in messages():
        parts.append(_struct(kind))
        if NODE in spec_of(kind).receivers:
            parts.append("\n".join(_unpack(kind)))
        if NODE in spec_of(kind).senders:
            parts.append("\n".join(_pack(kind)))
            parts.append(_send(kind))
    return "\n\n".join(parts) + "\n"


def _enum(kind: type[IntEnum] | type[IntFlag]) -> str:
    name = snake(kind.__name__)
    members = ", ".join(
        f"OPC4_{name.upper()}_{m.name} = {m.value}" for m in kind.__members__.values()
    )
    return f"enum opc4_{name} {{ {members} }};"


def _fields(kind: type) -> list[_Field]:
    spec, fields = spec_of(kind), []
    for (name, hint), signal in zip(get_type_hints(kind).items(), SIGNALS[kind], strict=True):
        optional = type(None) in get_args(hint)
        expected = conversion_of(hint, spec.signal(signal)).expected
        inner = get_args(hint)[0] if optional else hint
        fields.append(_Field(name, inner, spec.signal(signal), optional, expected))
    return fields


def _struct(kind: type) -> str:
    spec, name = spec_of(kind), snake(kind.__name__)
    lines = [f"/* {' '.join((kind.__doc__ or '').split())} */"]
    lines.append(f"#define OPC4_{name.upper()}_ID 0x{spec.can_id:08X}u")
    if spec.e2e_data_ids:
        ids = ", ".join(map(str, spec.e2e_data_ids))
        lines.append(f"static const uint8_t opc4_{name}_data_ids[16] = {{ {ids} }};")
    lines.append(f"struct opc4_{name} {{")
    for field in _fields(kind):
        text = ", ".join(filter(None, (unit_of(field.name), field.expected)))
        if field.optional:
            lines.append(f"    bool has_{field.name};")
        size = "[2]" if field.hint is str else ""
        lines.append(f"    {field.c_type} {field.name}{size}; /* {text} */")
    return "\n".join([*lines, "};"])


def _unused(kind: type) -> tuple[int, bool]:
    """Return the unused bits of a message, and whether a receiver checks that they are 1."""
    spec = spec_of(kind)
    used = sum(signal.mask << signal.start for signal in spec.signals)
    is_checked = split_id(spec.can_id).pgn & 0xFF00 == 0xFF00
    return ((1 << 8 * spec.length) - 1) ^ used, is_checked


def _pack(kind: type) -> Iterator[str]:
    name, (unused, _) = snake(kind.__name__), _unused(kind)
    yield "/* Return NULL, or which field cannot be sent. */"
    yield f"static inline const char *opc4_pack_{name}(const struct opc4_{name} *message, struct opc4_frame *frame)"
    yield "{"
    yield f"    uint64_t word = 0x{unused:016X}u;"
    for field in _fields(kind):
        signal, value, (low, high) = field.signal, f"message->{field.name}", field.limits
        what = f"{kind.__name__}.{field.name} cannot be sent; expected {field.expected}"
        indent = "    " if field.optional else ""
        if field.optional:
            yield f"    if (!message->has_{field.name}) {{"
            yield f"        word |= (uint64_t)0x{signal.mask:X}u << {signal.start};"
            yield "    } else {"
        if field.hint is float:
            to_si, by = map(repr, SI_FACTORS[signal.unit])
            numbers = f"{by}, {to_si}, {float(signal.offset)!r}, {float(signal.factor)!r}, {low}.0, {high}.0"
            yield f"{indent}    if (!opc4_put_number(&word, {value}, {numbers}, 0x{signal.mask:X}u, {signal.start}))"
        elif field.hint is str:
            yield f"{indent}    if (!opc4_put_text(&word, {value}, {signal.start}))"
        else:
            offset = int(signal.offset)
            yield f"{indent}    if (!opc4_put_whole(&word, (int32_t){value}, {low}, {high}, {offset}, {signal.start}))"
        yield f'{indent}        return "{what}";'
        if field.optional:
            yield "    }"
    yield f"    opc4_put_word(frame, OPC4_{name.upper()}_ID, word);"
    yield "    return NULL;"
    yield "}"


def _unpack(kind: type) -> Iterator[str]:
    name, (unused, is_checked) = snake(kind.__name__), _unused(kind)
    yield "/* Return whether the frame is such a message; checksum and counter are not looked at. */"
    yield f"static inline bool opc4_unpack_{name}(const struct opc4_frame *frame, struct opc4_{name} *message)"
    yield "{"
    yield "    const uint64_t word = opc4_get_word(frame);"
    test = f" || (word & 0x{unused:016X}u) != 0x{unused:016X}u" if is_checked and unused else ""
    yield f"    if (frame->id != OPC4_{name.upper()}_ID || frame->length != 8{test})"
    yield "        return false;"
    for field in _fields(kind):
        signal, target = field.signal, f"message->{field.name}"
        raw = f"(int32_t)(word >> {signal.start} & 0x{signal.mask:X}u)"
        if field.hint is float and signal.signed:
            raw = f"opc4_signed({raw}, 0x{signal.mask:X})"
        if field.optional:
            first = missing_from(field.hint is str, signal)
            yield f"    message->has_{field.name} = {raw} < {first};"
            yield f"    if (message->has_{field.name} && {_refused(field, raw)})"
        else:
            yield f"    if ({_refused(field, raw)})"
        yield "        return false;"
        yield f"    {_assigned(field, target, raw)}"
    yield "    return true;"
    yield "}"


def _refused(field: _Field, raw: str) -> str:
    offset = int(field.signal.offset) if field.hint is int else 0
    low, high = field.limits
    return f"!opc4_is_within({raw}, {low - offset}, {high - offset})"


def _assigned(field: _Field, target: str, raw: str) -> str:
    signal = field.signal
    if field.hint is float:
        to_si, by = map(repr, SI_FACTORS[signal.unit])
        return f"{target} = ({raw} * {float(signal.factor)!r} + {float(signal.offset)!r}) * {to_si} / {by};"
    if field.hint is int:
        return f"{target} = {raw} + {int(signal.offset)};".replace("+ -", "- ")
    return f"{target} = {raw} != 0;" if field.hint is bool else f"{target} = ({field.c_type}){raw};"


def _send(kind: type) -> str:
    name = snake(kind.__name__)
    is_protected = bool(spec_of(kind).e2e_data_ids)
    protect = f"    opc4_protect(&frame, opc4_{name}_data_ids, &counter);"
    lines = [
        f"static inline void opc4_send_{name}_at(const struct opc4_{name} *message, const char *file, uint32_t line)",
        "{",
        *(["    static uint8_t counter;"] if is_protected else []),
        "    struct opc4_frame frame;",
        f"    const char *refused = opc4_pack_{name}(message, &frame);",
        "    if (refused != NULL) {",
        "        opc4_fail_at(refused, file, line);",
        "        return;",
        "    }",
        *([protect] if is_protected else []),
        "    opc4_send_at(&frame, file, line);",
        "}",
        f"#define opc4_send_{name}(message) opc4_send_{name}_at((message), __FILE__, __LINE__)",
    ]
    return "\n".join(lines)
