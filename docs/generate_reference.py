"""The reference, made from docstrings, the commands' arguments and opc4.dbc.

python -m docs.generate_reference            write reference.md beside this file
Checked by: tests/unit/sil/test_docs.py (made again, and the same)
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("reference.md")
RESULTS = (
    "sil.api:Run",
    "sil.simulation.metrics:Shift",
    "sil.simulation.results:Check",
    "sil.campaign.simulate:SimulatedStroke",
    "sil.api:Sweep",
    "sil.diagnosis.diagnosis:Diagnosis",
    "sil.log_replay.replay:Outcome",
    "can_dbc.errors:InputError",
    "can_dbc.errors:RunError",
)
CONTROLLER = (
    "controller.firmware:Inputs",
    "controller.firmware:Outputs",
    "controller.config:FirmwareConfig",
    "controller.position:Calibration",
)
PLANT = (
    "plant.parameters:load",
    "plant.parameters:ParameterSet",
    "plant.effects.stroke_conditions:StrokeConditions",
    "plant.systems.stroke:simulate",
    "plant.systems.stroke:Stroke",
    "plant.systems.length_stroke:LengthStroke",
)
HEAD = """\
# Reference

Made by `python -m docs.generate_reference` from docstrings, the commands' arguments and `opc4.dbc`; a test makes it again
and compares. Parameters with value, unit and source: `plant/parameters/nominal.toml`.
"""


def reference() -> str:
    """The whole page."""
    import sil

    lines = [HEAD, "## Python", "", "`from sil import " + ", ".join(sil.__all__) + "`", ""]
    for name in sil.__all__:
        lines += about(name, getattr(sil, name))
    for title, places in (
        ("What they return and raise", RESULTS),
        ("What a controller of your own is given and returns", CONTROLLER),
        ("The plant alone", PLANT),
    ):
        lines += [f"## {title}", ""]
        for place in places:
            module, _, name = place.partition(":")
            lines += about(f"{module}.{name}", getattr(importlib.import_module(module), name))
    return "\n".join([*lines, *commands(), *messages()]).rstrip() + "\n"


def about(name: str, what: Any) -> Iterator[str]:
    """A function or class: signature or fields, docstring, public methods."""
    yield f"### `{name}`"
    yield ""
    if inspect.isfunction(what):
        yield f"```python\n{signature(name.rpartition('.')[2], what)}\n```"
        yield ""
    yield from text(what)
    if not inspect.isclass(what):
        return
    fields = list(fields_of(what))
    if fields:
        yield "| field | type |"
        yield "|---|---|"
        for field, kind in fields:
            yield f"| `{field}` | `{cell(kind)}` |"
        yield ""
    for method, value in vars(what).items():
        found = getattr(value, "fget", None) or getattr(value, "__func__", value)
        if not method.startswith("_") and inspect.isfunction(found) and found.__doc__:
            first = inspect.getdoc(found).split("\n\n")[0].replace("\n", " ")  # type: ignore[union-attr]
            call = method if isinstance(value, property) else signature(method, found)
            yield f"- `{call}`: {first}"
    yield ""


def fields_of(what: type) -> Iterator[tuple[str, str]]:
    """Names and types of the values that a record holds."""
    names: tuple[str, ...]
    if dataclasses.is_dataclass(what):
        names = tuple(field.name for field in dataclasses.fields(what))
    else:
        names = tuple(getattr(what, "_fields", ()) or getattr(what, "__struct_fields__", ()))
    kinds = {k: v for c in reversed(what.__mro__) for k, v in inspect.get_annotations(c).items()}
    for name in names:
        if not name.startswith("_"):
            kind = kinds.get(name, "")
            yield name, getattr(kind, "__forward_arg__", str(kind))


class _AsWritten(str):
    """A type as the source has it, without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def signature(name: str, function: Any) -> str:
    """The call of a function, its types as they are written."""
    found = inspect.signature(function)
    parameters = [
        p.replace(annotation=_AsWritten(p.annotation)) if isinstance(p.annotation, str) else p
        for p in found.parameters.values()
        if p.name not in ("self", "cls")
    ]
    kind = found.return_annotation
    returned = _AsWritten(kind) if isinstance(kind, str) else kind
    return f"{name}{found.replace(parameters=parameters, return_annotation=returned)}"


def text(what: Any) -> Iterator[str]:
    """A docstring, without the line that names its test."""
    found = inspect.getdoc(what) or ""
    for line in found.split("\n"):
        yield line.partition("Checked by")[0].rstrip()
    yield ""


def cell(told: str) -> str:
    """A text that stays within its cell of a table."""
    return told.replace("|", "\\|").replace("\n", " ")


def commands() -> Iterator[str]:
    """The arguments of each command."""
    from sil.cli import COMMANDS

    yield "## Commands"
    yield ""
    yield "Exit codes: 0 done and passed, 1 an expectation failed or a difference was found, 2 bad input, 3 a"
    yield "participant died or the run could not finish. `opc4 COMMAND --help` has an example of each."
    yield ""
    for name, summary in COMMANDS.items():
        command = importlib.import_module(f"sil.cli.{name}")
        parser = argparse.ArgumentParser(prog=f"opc4 {name}", add_help=False)
        command.add_arguments(parser)
        yield f"### `opc4 {name}`"
        yield ""
        yield f"{summary[0].upper()}{summary[1:]}."
        yield ""
        yield "| argument | |"
        yield "|---|---|"
        for action in parser._actions:
            yield f"| `{cell(spelled(action))}` | {cell(action.help or '')} |"
        yield ""


def spelled(action: argparse.Action) -> str:
    """An argument as it is typed."""
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if isinstance(value, tuple):
        value = " ".join(value)
    if not action.option_strings:
        return value
    takes_none = action.nargs == 0
    return ", ".join(action.option_strings) + ("" if takes_none else f" {value}")


def messages() -> Iterator[str]:
    """Every message of the bus, with its signals."""
    from can_dbc.contract import contract

    found = contract()
    yield "## Messages"
    yield ""
    yield f"`can_dbc/opc4.dbc`; {found.bitrate} bit/s, 29-bit identifiers."
    yield ""
    for message in found.messages:
        period = f"every {message.cycle_ns / 1e6:g} ms" if message.cycle_ns else "without a period"
        safe = ", end-to-end protected" if message.e2e_data_ids else ""
        yield f"### {message.name}"
        yield ""
        yield f"`0x{message.can_id:08X}`, {message.length} bytes, from {', '.join(message.senders)}, {period}{safe}."
        yield ""
        if message.comment:
            yield message.comment
            yield ""
        yield "| signal | bits | factor, offset | range | unit | |"
        yield "|---|---|---|---|---|---|"
        for s in message.signals:
            choices = "; ".join(f"{code} {name}" for code, name in s.choices.items())
            told = cell(" ".join(part for part in (s.comment, choices) if part))
            yield (
                f"| {s.name} | {s.start}, {s.length}{' signed' if s.signed else ''} | "
                f"{s.factor:g}, {s.offset:g} | {s.minimum:g} to {s.maximum:g} | {s.unit} | {told} |"
            )
        yield ""


if __name__ == "__main__":
    PAGE.write_text(reference(), encoding="utf-8")
