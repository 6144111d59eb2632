"""Options that several commands share."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add --out and --force; `default` is the folder without them."""
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the output, made if missing [{default}]",
    )
    parser.add_argument(
        "--force", action="store_true", help="replace the run that the folder holds"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add --json."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on standard output, nothing else"
    )


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add --model and --set."""
    parser.add_argument(
        "--model", metavar="FILE", help="model file, or name of a parameter set [nominal]"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        dest="settings",
        help="change one value, e.g. valve.D_fall=0.02 or controller.filter=false; repeatable",
    )


def say(message: str) -> None:
    """Print a message for the user on standard error."""
    print(message, file=sys.stderr, flush=True)
