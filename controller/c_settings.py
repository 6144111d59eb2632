"""The firmware's settings as one struct in C, of members of 8 bytes: its declaration, and its content for a run."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from msgspec import Struct

from controller import strategies
from controller.config import FirmwareConfig
from controller.filters import butterworth

STRATEGIES = ("open_loop", "blow_cut", "air_cushion", "synchro_brake", "sliding_mode")
"""Strategies whose parameters the struct holds: those of the firmware in C."""


class _Member(NamedTuple):
    """A member with its value, or the begin (value None, name) or end (no name) of a nested struct."""

    name: str
    value: float | int | tuple[float, ...] | None
    unit: str = ""


def declaration() -> str:
    """Return the struct, its enums before it."""
    lines = [
        f"enum opc4_strategy {{ {_enum('OPC4_STRATEGY', strategies.NAMES)} }};",
        f"enum opc4_cut {{ {_enum('OPC4_CUT', ('none', 'sync', 'confirmation'))} }};",
        "",
        "/* Times are in seconds: opc4_ns rounds them as the firmware in Python does. */",
        "struct opc4_settings {",
    ]
    inside: list[str] = []
    for member in _members(FirmwareConfig()):
        indent = "    " * (len(inside) + 1)
        if member.value is None and member.name:
            lines.append(f"{indent}struct {{")
            inside.append(member.name)
        elif member.value is None:
            lines.append(f"{indent[4:]}}} {inside.pop()};")
        else:
            kind = "int64_t" if isinstance(member.value, int) else "double"
            unit = f" /* {member.unit} */" if member.unit else ""
            lines.append(f"{indent}{kind} {member.name};{unit}")
    return "\n".join([*lines, "};"]) + "\n"


def content(config: FirmwareConfig) -> bytes:
    """Return the bytes of the struct, little-endian."""
    values: list[float | int] = []
    for member in _members(config):
        if isinstance(member.value, tuple):
            values += member.value
        elif member.value is not None:
            values.append(member.value)
    codes = "".join("q" if isinstance(value, int) else "d" for value in values)
    return struct.pack(f"<{codes}", *values)


def _enum(prefix: str, names: Any) -> str:
    return ", ".join(f"{prefix}_{name.upper()} = {k}" for k, name in enumerate(names))


def _members(config: FirmwareConfig) -> Iterator[_Member]:
    yield from _of_record(config)
    yield _Member("strategy", list(strategies.NAMES).index(config.strategy))
    for name in STRATEGIES:
        table = config.strategy_parameters if name == config.strategy else {}
        parameters = strategies.parameters(name, table)
        if parameters.__struct_fields__:
            yield _Member(name, None)
            yield from _of_record(parameters)
            yield _Member("", None)
    filtering = config.filter
    sections = butterworth(filtering.order, filtering.fc_hz, 1.0 / config.sensor.period_s)
    yield _Member("section_count", len(sections))
    numbers = [number for section in sections for number in section]
    numbers += [0.0] * (5 * 4 - len(numbers))  # of a filter of the highest order
    yield _Member("sections[4][5]", tuple(numbers), "b0, b1, b2, a1, a2 of each")


@cache
def _hints(kind: type[Struct]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _of_record(record: Struct) -> Iterator[_Member]:
    """Yield the members of a settings record; the strategy and its parameters come otherwise."""
    for name, hint in _hints(type(record)).items():
        if name.startswith("strategy") or name not in record.__struct_fields__:
            continue
        value = getattr(record, name)
        unit = next((meta.description for meta in getattr(hint, "__metadata__", ())), "")
        if isinstance(value, Struct):
            yield _Member(name, None)
            yield from _of_record(value)
            yield _Member("", None)
        elif get_origin(hint) is Literal:
            yield _Member(name, get_args(hint).index(value))
        else:
            kind = get_args(hint)[0] if get_args(hint) else hint
            yield _Member(name, float(value) if kind is float else int(value), unit)
