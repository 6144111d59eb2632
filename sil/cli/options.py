"""What several commands share: arguments as tables, drafts of a user's own files, how they print."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError

if TYPE_CHECKING:
    from sil.logs.merged import Reading

Argument = tuple[str, dict[str, Any]]  # name, and how argparse takes it


def argument(name: str, text: str, metavar: str | None = None, **how: Any) -> Argument:
    """Return an argument with its help; an option without a metavar is a switch."""
    if name.startswith("--") and metavar is None and not how:
        how["action"] = "store_true"
    elif metavar is not None:
        how["metavar"] = metavar
    return name, {"help": text, **how}


class _Setting(argparse.Action):
    """Collects --set PATH=VALUE as values by path."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, text: Any, *_: Any) -> None:
        from sil.files.overrides import parse_setting

        path, value = parse_setting(text)
        namespace.settings = {**namespace.settings, path: value}


class _Firmware(argparse.Action):
    """Takes --firmware FILE as the value `firmware` among those of --set."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, text: Any, *_: Any) -> None:
        namespace.settings = {**namespace.settings, "firmware": text}


def out(default: str) -> tuple[Argument, Argument]:
    """Return --out and --force; `default` is the folder without them."""
    text = f"folder for the output, made if missing [{default}]"
    force = argument("--force", "replace what the folder holds")
    return argument("--out", text, "DIR", type=Path), force


LAYOUT = (
    argument("--map", "meaning of the signals of a truck's log with another layout (TOML)", "FILE"),
    argument("--dbc", "database with the signals that --map names", "FILE"),
)
NEW = argument("--new", "write a commented draft that runs as it is, and do nothing else", "FILE", type=Path)  # fmt: skip
JSON = argument("--json", "print one JSON object on standard output, nothing else")
OWN_RULES = argument("--rules", "rules of one's own as well: RULES in a Python file", "FILE.py")
SEED = argument("--seed", "seed of everything random", "N", type=int)
MODEL = argument("--model", "model file, or name of a parameter set [nominal]", "FILE")
SETTINGS = argument(
    "--set",
    "change one value, e.g. valve.D_fall=0.02 or controller.filter=false; repeatable",
    "PATH=VALUE",
    action=_Setting,
    default={},
    dest="settings",
)
FIRMWARE = argument(
    "--firmware",
    "a firmware of your own: FILE.py, FILE.py:CLASS, FILE.c, FILE.wasm; c: the shipped one in C",
    "FILE",
    action=_Firmware,
    default={},
    dest="settings",
)
EFFECTS = argument(
    "--effects",
    "add the effects of a Python file to the catalogue; repeatable",
    "FILE.py",
    action="append",
    default=[],
)
STRICT = argument("--strict", "refuse a log with anything broken")
TIMES = argument(
    "--times",
    "how the times of a candump screen log are meant [auto]",
    default="auto",
    choices=("auto", "delta", "recorded"),
)


SELECTION = (
    argument(
        "--since",
        "only from here: seconds from the first frame or from 1970, or a UTC date",
        "TIME",
    ),
    argument("--until", "only up to here", "TIME"),
    *(
        argument(name, text, metavar, action="append", default=[])
        for name, text, metavar in (
            ("--id", "only these identifiers, hex, commas between; repeatable", "ID"),
            ("--pgn", "only these J1939 parameter groups, and those of --id; repeatable", "PGN"),
            ("--channel", "only these channels; repeatable", "NAME"),
        )
    ),
)
"""The filters of a log."""


def reading(arguments: argparse.Namespace) -> Reading:
    """Return how logs are to be read, by SELECTION, STRICT and TIMES. Raises InputError for a bad filter."""
    from sil.logs.selection import Selection

    since, until, channels = arguments.since, arguments.until, arguments.channel
    chosen = Selection.parse(
        since=since, until=until, ids=arguments.id, pgns=arguments.pgn, channels=channels
    )
    strict, times = arguments.strict, arguments.times
    return {"selection": chosen, "strict": strict, "times": times, "show_progress": True}


def say(message: str) -> None:
    """Print a message for the user on standard error."""
    print(message, file=sys.stderr, flush=True)


def table_lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for first, *others in (head, *rows):
        cells = [text.rjust(width) for text, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return lines


def write_draft(command: str, arguments: argparse.Namespace, then: str) -> int:
    """Write the draft of a command's file to `arguments.new`; `then` is the command to type next.

    Raises InputError for a suffix without a draft, and for a file that exists, without --force.
    """
    from sil.files.atomic import write_atomically
    from sil.files.overrides import toml_value

    path: Path = arguments.new
    shipped = sorted((Path(__file__).parent / "drafts").glob(f"{command}.*"))
    drafts = {draft.suffix: draft for draft in shipped}
    if path.suffix not in drafts:
        expected = " or ".join(f"FILE{suffix}" for suffix in drafts)
        raise InputError(f"{path}: --new: no draft of such a file; expected {expected}")
    if path.exists() and not arguments.force:
        raise InputError(f"{path}: --new: exists; expected a new file, or --force")
    if not path.parent.is_dir() or path.is_dir():
        raise InputError(f"{path}: --new: no such folder; expected a file in one that exists")
    text = drafts[path.suffix].read_text(encoding="utf-8")
    text = text.replace("THIS_FILE", str(path)).replace('"draft"', toml_value(path.stem[:80]))
    write_atomically(path, text)
    if arguments.json:
        print(json.dumps({"file": str(path), "then": then}, ensure_ascii=False))
    else:
        print(f"{path}: a draft that runs as it is: {then}")
    return 0
