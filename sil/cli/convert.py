"""Convert logs of frames between candump, ASC, BLF, TRC, MF4 and CSV, and traces to MF4.

The formats follow from the names; .gz packs. What is broken in a log is counted, located and left
out, or refused with --strict.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sil.cli.options import add_json

EXAMPLE = """\
example:
  opc4 convert runs/full_shift-1/bus.log full_shift.asc
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", metavar="IN", help="log, or a run's trace.csv")
    parser.add_argument("target", metavar="OUT", help="file to write")
    parser.add_argument("--from", dest="source_format", metavar="FORMAT", help="format of IN")
    parser.add_argument("--to", dest="target_format", metavar="FORMAT", help="format of OUT")
    parser.add_argument("--strict", action="store_true", help="refuse a log with anything broken")
    parser.add_argument(
        "--times",
        default="auto",
        choices=("auto", "delta", "recorded"),
        help="how the times of a candump screen log are meant [auto]",
    )
    parser.add_argument("--force", action="store_true", help="replace OUT")
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Convert a log; return the exit code. Raises InputError for bad input."""
    from can_dbc.errors import InputError
    from sil.logs.convert import convert

    if Path(arguments.target).exists() and not arguments.force:
        raise InputError(f"{arguments.target}: exists; expected a new name, or --force")
    report = convert(
        arguments.source,
        arguments.target,
        strict=arguments.strict,
        times=arguments.times,
        source_format=arguments.source_format,
        target_format=arguments.target_format,
    )
    if arguments.json:
        print(json.dumps(report.as_dict(), ensure_ascii=False))
    else:
        print("\n".join(report.lines()))
    return 0
