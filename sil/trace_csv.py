"""trace.csv: the truth of a run and what the controller believed, on one time axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from can_dbc.messages import ControllerStatus
from sil.results import write_whole
from sil.run_record import Floats, RunRecord

FIRST = (
    "time_s",
    "position_m",
    "pressure_B_pa",
    "pressure_N_pa",
    "pressure_F_pa",
    "cmd_B",
    "cmd_N",
    "cmd_F",
    "position_internal_m",
)
"""The columns that a measured stroke has too come first, in its order."""

WHOLE = frozenset(("valve_B", "valve_N", "valve_F", "controller_state", "controller_faults"))


def held(times: Floats, values: Floats, at: Floats) -> Floats:
    """Return a held series at given instants; not a number before its first value."""
    padded = np.concatenate([[np.nan], values])
    return np.asarray(padded[np.searchsorted(times, at, side="right")])


def trace_columns(record: RunRecord) -> dict[str, Floats]:
    """Return all columns of trace.csv: the plant's, and the controller's as held at its frames."""
    at = record.truth["time_s"]
    when, states = record.series(ControllerStatus, "state")
    _, faults = record.series(ControllerStatus, "faults")
    columns = dict(record.truth)
    columns["position_internal_m"] = held(*record.believed, at)
    columns["controller_state"] = held(when, np.array(states, dtype=np.float64), at)
    columns["controller_faults"] = held(when, np.array(faults, dtype=np.float64), at)
    rest = [name for name in columns if name not in FIRST]
    return {name: columns[name] for name in (*FIRST, *rest)}


def write_trace_csv(record: RunRecord, path: Path) -> None:
    """Write the trace; every number reads back to the same bits, an unknown one is left empty."""
    columns = trace_columns(record)
    texts = [
        ["" if v != v else str(int(v)) for v in column.tolist()]
        if name in WHOLE
        else ["" if v != v else repr(v) for v in column.tolist()]
        for name, column in columns.items()
    ]
    lines = [",".join(columns), *(",".join(row) for row in zip(*texts, strict=True)), ""]
    write_whole(path, "\n".join(lines))
