"""A run that was written to a folder, read back for comparisons: result, trace, events after the request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from can_dbc.errors import InputError
from can_dbc.messages import Fault, ShiftState
from can_dbc.typed_toml import convert
from can_dbc.user_file import parse_json, read_user_file
from sil.files.output_folder import RESULT
from sil.recording.recorder import EVENTS
from sil.recording.run_reader import event_of
from sil.recording.run_record import CHAMBERS, Floats
from sil.simulation.metrics import METRICS, Shift
from sil.simulation.safety import FaultSpan, fault_spans
from sil.simulation.scenario import Scenario

MOST_BYTES = 1 << 30  # the largest file of a run that is read
COLUMNS = (
    *("time_s", "position_m", "velocity_m_s", "position_internal_m"),
    *("controller_state", "controller_faults"),
    *(name for c in CHAMBERS for name in (f"pressure_{c}_pa", f"valve_{c}")),
)
"""What is read of trace.csv."""


class _Metrics(msgspec.Struct, frozen=True):
    shifts: list[Shift] = []


class _Stored(msgspec.Struct, frozen=True):
    scenario_name: str
    complete: bool
    metrics: dict[str, Any]
    trace_sha256: str | None
    scenario: dict[str, Any]


@dataclass(frozen=True)
class KeptRun:
    """A finished run: metrics of result.json, shifts, columns [n] of trace.csv in SI units, events (time in s, name)."""

    name: str
    scenario_name: str
    trace_sha256: str | None
    metrics: Mapping[str, Any]
    shifts: Sequence[Shift]
    trace: Mapping[str, Floats]
    events: Sequence[tuple[float, str]]
    faults: Sequence[FaultSpan]

    def span(self, shift: int) -> tuple[float, float]:
        """Return from when to when a shift lasts, in s: until the next request, or the end."""
        starts = [each.requested_s for each in self.shifts] or [0.0]
        return starts[shift], [*starts[1:], float(self.trace["time_s"][-1])][shift]


def read_run(where: Path, name: str) -> KeptRun:
    """Read a run's folder, or the folder of its result.json.

    Raises InputError for a file that is missing or not of a run, and for a run that did not finish.
    """
    folder = where.parent if where.name == RESULT else where
    path = folder / RESULT
    try:
        raw = parse_json(read_user_file(path, "the result.json of a run", MOST_BYTES))
    except ValueError:
        raise InputError(f"{path}: not JSON; expected the result.json of a run") from None
    stored = convert(raw, _Stored, str(path))
    if not stored.complete:
        raise InputError(f"{path}: the run did not finish; expected a complete one")
    shifts = convert(stored.metrics, _Metrics, str(path), "metrics").shifts
    numbers = {name: stored.metrics.get(name) for name in METRICS}
    convert(numbers, dict[str, float | None], str(path), "metrics")
    trace = _read_trace(folder / "trace.csv")
    events = [*_plant_events(folder / EVENTS), *_controller_events(trace)]
    faults = fault_spans(convert(stored.scenario, Scenario, str(path), "scenario"))
    figures = stored.scenario_name, stored.trace_sha256, stored.metrics
    return KeptRun(name, *figures, shifts, trace, sorted(events), faults)


def _read_trace(path: Path) -> dict[str, Floats]:
    content = read_user_file(path, "the trace of a run", MOST_BYTES)
    lines = content.decode(errors="replace").splitlines()
    names = lines[0].split(",") if len(lines) > 2 else []
    missing = [name for name in COLUMNS if name not in names]
    try:
        if missing:
            raise ValueError
        rows = np.genfromtxt(lines[1:], delimiter=",", ndmin=2)
        return dict(zip(names, rows.T, strict=True))
    except ValueError:
        what = f"no {missing[0]}" if missing else "not a table of numbers"
        raise InputError(f"{path}: {what}; expected the trace.csv of a run") from None


def _plant_events(path: Path) -> Iterator[tuple[float, str]]:
    content = read_user_file(path, "the events of a run", MOST_BYTES)
    for number, line in enumerate(content.splitlines(), 1):
        event = event_of(line, f"{path}:{number}")
        if event.name != "balance":
            yield event.time_s, event.name.replace("_", " ")


def _controller_events(trace: Mapping[str, Floats]) -> Iterator[tuple[float, str]]:
    """Yield when the controller reports another state, or a fault that it did not report before."""
    time_s, names = trace["time_s"], {int(state): state.name for state in ShiftState}
    states = np.nan_to_num(trace["controller_state"], nan=-1).astype(int)
    for row in np.flatnonzero(np.diff(states)) + 1:
        yield float(time_s[row]), f"state {names.get(int(states[row]), states[row])}"
    faults = np.nan_to_num(trace["controller_faults"]).astype(int)
    for fault in Fault:
        if fault and (reported := np.flatnonzero(faults & fault.value)).size:
            yield float(time_s[reported[0]]), f"{fault.name} reported"


class EventRow(msgspec.Struct, frozen=True, kw_only=True):
    """One event of several runs: its shift, from 1, and its times after the request in s, None where it is missing."""

    shift: int
    name: str
    after_request_s: list[float | None]

    @property
    def differs(self) -> bool:
        """Whether it is missing in a run, or its times differ by more than a microsecond."""
        times = [time for time in self.after_request_s if time is not None]
        return len(times) < len(self.after_request_s) or max(times) - min(times) > 1e-6


def event_rows(runs: Sequence[KeptRun]) -> list[EventRow]:
    """Return the events of all runs by shift and time; repeated ones are matched by their number."""
    times: dict[tuple[int, str], list[float | None]] = {}
    for k, run in enumerate(runs):
        for shift in range(max(1, len(run.shifts))):
            begin, end = run.span(shift)
            counts: Counter[str] = Counter()
            for at_s, name in _events_of(run, shift):
                if begin <= at_s < end:
                    counts[name] += 1
                    label = name if counts[name] == 1 else f"{name} ({counts[name]})"
                    row = times.setdefault((shift + 1, label), [None] * len(runs))
                    row[k] = at_s - begin
    rows = [
        EventRow(shift=shift, name=name, after_request_s=row)
        for (shift, name), row in times.items()
    ]
    return sorted(rows, key=lambda r: (r.shift, min(t for t in r.after_request_s if t is not None)))


def _events_of(run: KeptRun, shift: int) -> Iterator[tuple[float, str]]:
    yield from run.events
    if run.shifts:
        for name in ("commanded_s", "first_motion_s", "arrived_s", "confirmed_s", "blow_end_s"):
            if (at_s := getattr(run.shifts[shift], name)) is not None:
                yield at_s, name.removesuffix("_s").replace("_", " ")
