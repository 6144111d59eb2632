"""Generate the reference pages from the code: commands, CAN contract.

`python docs/generate.py` writes them to docs/reference; a test checks that they are up to date.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).parent / "reference"


def pages() -> dict[str, str]:
    """Return the text of every generated page by file name."""
    made = {
        "cli.md": ("Commands", commands()),
        "can.md": ("CAN contract", messages()),
    }
    return {
        name: "\n".join([f"# {title}", "", *lines]).rstrip() + "\n"
        for name, (title, lines) in made.items()
    }


def cell(text: str) -> str:
    """Return a text that fits into a table cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def commands() -> Iterator[str]:
    """Yield the lines of the page of commands."""
    from sil.cli import COMMANDS

    yield "Exit codes: 0 done and passed, 1 an expectation failed or a difference was found, 2 bad input, 3 a"
    yield "participant died or the run could not finish. `opc4 COMMAND --help` has an example of each."
    yield ""
    for name, summary in COMMANDS.items():
        command = importlib.import_module(f"sil.cli.{name}")
        parser = argparse.ArgumentParser(prog=f"opc4 {name}", add_help=False)
        command.add_arguments(parser)
        yield f"## `opc4 {name}`"
        yield ""
        yield f"{summary[0].upper()}{summary[1:]}."
        yield ""
        yield "| argument | |"
        yield "|---|---|"
        for action in parser._actions:
            yield f"| `{cell(spelled(action))}` | {cell(action.help or '')} |"
        yield ""


def spelled(action: argparse.Action) -> str:
    """Return an argument as one types it."""
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
    """Yield the lines of the page of the CAN contract."""
    from can_dbc.contract import contract

    found = contract()
    yield f"`can_dbc/opc4.dbc`; {found.bitrate} bit/s, 29-bit identifiers."
    yield ""
    for message in found.messages:
        period = f"every {message.cycle_ns / 1e6:g} ms" if message.cycle_ns else "without a period"
        safe = ", end-to-end protected" if message.e2e_data_ids else ""
        yield f"## {message.name}"
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
            comment = cell(" ".join(part for part in (s.comment, choices) if part))
            yield (
                f"| {s.name} | {s.start}, {s.length}{' signed' if s.signed else ''} | "
                f"{s.factor:g}, {s.offset:g} | {s.minimum:g} to {s.maximum:g} | {s.unit} | {comment} |"
            )
        yield ""


if __name__ == "__main__":
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
