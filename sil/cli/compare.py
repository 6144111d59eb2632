"""Compare runs: metrics, traces over each other aligned at the request, events that differ.

example: opc4 compare runs/lab_n_b-1 runs/lab_n_b-2
"""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path

from can_dbc.errors import InputError
from sil.cli.options import JSON, argument, out, table_lines

ARGUMENTS = (
    argument("run", "folders of runs, or their result.json", "RUN", nargs="+", type=Path),
    argument("--exact", "exit 1 if the traces differ in any bit"),
    *(*out("runs/compare-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print; return the exit code. Raises InputError for what is not a finished run."""
    import msgspec

    from sil.files.atomic import write_atomically
    from sil.files.output_folder import close_folders, finite, prepare_folder
    from sil.report.compare_page import event_cells, head_of, write_page
    from sil.simulation.compared import metric_rows
    from sil.simulation.kept_run import event_rows, read_run

    if len(arguments.run) < 2:
        raise InputError(f"{arguments.run[0]}: one run; expected two or more")
    runs = [read_run(*each) for each in zip(arguments.run, _names(arguments.run), strict=True)]
    metrics = metric_rows([each.metrics for each in runs])
    events = [row for row in event_rows(runs) if row.differs]
    hashes = {each.trace_sha256 for each in runs}
    equal = len(hashes) == 1 and None not in hashes
    folder = prepare_folder(arguments.out, "compare", arguments.force, map(str, arguments.run))
    again = shlex.join(["opc4", "compare", *map(str, arguments.run)])
    write_page(runs, metrics, events, equal, folder, again)
    report = {
        "runs": [
            {"name": each.name, "scenario": each.scenario_name, "trace_sha256": each.trace_sha256}
            for each in runs
        ],
        "traces_equal": equal,
        "metrics": msgspec.to_builtins(metrics),
        "events": msgspec.to_builtins(events),
    }
    write_atomically(folder / "compare.json", json.dumps(finite(report), indent=1) + "\n")
    if arguments.json:
        print(json.dumps(finite(report)))
    else:
        heads = head_of([each.name for each in runs])
        print("\n".join(table_lines(heads, [row.cells() for row in metrics])))
        if events:
            print(f"\nevents that differ: {len(events)}, by shift and time after the request:")
            cells = [event_cells(row) for row in events[:20]]
            print("\n".join(table_lines(heads, cells)))
        if (more := len(events) - 20) > 0:
            print(f"and {more} more, in compare.json")
        print(f"traces {'equal to the bit' if equal else 'differ'}; figure and page in {folder}")
    close_folders(None)
    return 1 if arguments.exact and not equal else 0


def _names(paths: list[Path]) -> list[str]:
    """Return what the runs are called: the names of their folders, or their paths if two are the same."""
    from can_dbc.user_file import resolved

    folders = [path.parent if path.name == "result.json" else path for path in paths]
    names = [resolved(folder).name for folder in folders]
    return names if len(set(names)) == len(names) else list(map(str, folders))
