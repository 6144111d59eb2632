"""Convert logs of frames between candump, ASC, BLF, TRC, MF4 and CSV, and traces to MF4.

The formats follow from the names; .gz packs. Several logs become one, ordered by time; - is standard
input or output. What is broken in a log is counted, located and left out, or refused with --strict. With --dbc
the signals are decoded: to CSV (one row per value), MF4 or parquet.

example:
  opc4 convert runs/full_shift-1/bus.log full_shift.asc
  opc4 convert day-1.blf day-2.blf day.mf4 --since 2026-01-31T12:00 --pgn 61442,61445
  candump -L can0 | opc4 convert - signals.csv --dbc truck.dbc
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.errors import InputError
from sil.cli.options import JSON, SELECTION, STRICT, TIMES, argument, reading

if TYPE_CHECKING:
    from sil.j1939.decode import DecodeReport
    from sil.logs.convert import ConvertReport


ARGUMENTS = (
    argument("source", "logs, or a run's trace.csv", "IN", nargs="+"),
    argument("target", "file to write", "OUT"),
    argument("--from", "format of IN", "FORMAT", dest="source_format"),
    argument("--to", "format of OUT", "FORMAT", dest="target_format"),
    argument("--dbc", "decode the signals of this database (J1939 too)", "FILE"),
    *(*SELECTION, STRICT, TIMES),
    argument("--force", "replace OUT"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Convert a log; return the exit code. Raises InputError for bad input."""
    from sil.j1939.decode import decode
    from sil.logs.convert import convert

    if arguments.target == "-" and arguments.json:
        what = "not with OUT -, which is standard output too; expected one of them"
        raise InputError(f"--json: {what}")
    path = Path(arguments.target)
    if path.exists() and not path.is_fifo() and not arguments.force:
        raise InputError(f"{arguments.target}: exists; expected a new name, or --force")
    how = reading(arguments) | {"format": arguments.source_format}
    report: ConvertReport | DecodeReport
    if arguments.dbc is not None:
        report = decode(arguments.source, arguments.target, arguments.dbc, **how)
    else:
        target_format = arguments.target_format
        report = convert(arguments.source, arguments.target, target_format=target_format, **how)
    if arguments.json:
        print(json.dumps(report.as_dict(), ensure_ascii=False))
    else:
        print("\n".join(report.lines()), file=sys.stderr if arguments.target == "-" else sys.stdout)
    return 0
