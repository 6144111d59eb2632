"""The arguments of the commands as tables, and those that several commands share."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sil.logs.merged import Reading

Argument = tuple[str, dict[str, Any]]
"""Name, and how argparse takes it."""


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
    return argument("--out", text, "DIR", type=Path), argument(
        "--force", "replace what the folder holds"
    )


LAYOUT = (
    argument("--map", "meaning of the signals of a truck's log with another layout (TOML)", "FILE"),
    argument("--dbc", "database with the signals that --map names", "FILE"),
)
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

    chosen = Selection.parse(
        since=arguments.since,
        until=arguments.until,
        ids=arguments.id,
        pgns=arguments.pgn,
        channels=arguments.channel,
    )
    return {
        "selection": chosen,
        "strict": arguments.strict,
        "times": arguments.times,
        "show_progress": True,
    }


def say(message: str) -> None:
    """Print a message for the user on standard error."""
    print(message, file=sys.stderr, flush=True)
