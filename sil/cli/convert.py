"""Convert logs of frames between candump, ASC, BLF, TRC, MF4 and CSV, and traces to MF4.

The formats follow from the names; .gz packs. What is broken in a log is counted, located and left
out, or refused with --strict.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sil.cli.options import JSON, STRICT, TIMES, argument

EXAMPLE = """\
example:
  opc4 convert runs/full_shift-1/bus.log full_shift.asc
"""


ARGUMENTS = (
    argument("source", "log, or a run's trace.csv", "IN"),
    argument("target", "file to write", "OUT"),
    argument("--from", "format of IN", "FORMAT", dest="source_format"),
    argument("--to", "format of OUT", "FORMAT", dest="target_format"),
    *(STRICT, TIMES),
    argument("--force", "replace OUT"),
    JSON,
)


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
