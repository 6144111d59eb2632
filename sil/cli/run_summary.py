"""What `opc4 run` prints of a finished run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from can_dbc.typed_toml import convert
from sil.cli.options import table_lines
from sil.files.quantity import counted
from sil.simulation.metrics import Shift
from sil.simulation.runner import Finished
from sil.simulation.safety import fault_lines
from sil.simulation.scenario import Scenario


def summary_lines(finished: Finished, folder: Path, changed_name: str) -> Iterator[str]:
    """Yield the checks, changes, shifts and files; `changed_name`: of a shipped scenario with other values."""
    result = finished.result
    failed = [check for check in result.expectations if not check.passed]
    shifts = [_shift_line(shift) for shift in finished.shifts[:12]]
    changes = result.changes
    if changes is None:
        met = f"{len(result.expectations) - len(failed)} of {len(result.expectations)}"
        yield f"{result.scenario_name}: {result.status}, {met} checks met"
    else:
        first = shifts.pop(0) if shifts else "no shift was requested"
        yield f"{changed_name}: {first}"
    for check in failed:
        yield f"  not met: {check}"
    yield from (f"  {line}" for line in shifts)
    if (more := len(finished.shifts) - 12) > 0:
        yield f"  and {counted(more, 'more shift')}, in result.json"
    if changes is not None:
        head = ("", "as shipped", "now", "difference")
        rows = [row.cells() for row in changes.metrics]
        none = ["no metric differs from the scenario as shipped"]
        yield from (f"  {line}" for line in (table_lines(head, rows) if rows else none))
        if count := len(changes.expectations):
            yield f"  {counted(count, 'expectation')} of the shipped scenario, changed:"
        for check in changes.expectations:
            yield "    " + str(check).replace(", expected ", ", as shipped ")
    if finished.record is not None:
        scenario = convert(result.scenario, Scenario, result.scenario_name)
        yield from (f"  {line}" for line in fault_lines(finished.record, scenario))
    if result.bus:
        frames = counted(result.bus["frames"], "frame")
        yield f"  bus {100 * result.bus['load']:.0f} % loaded, {frames}"
    if "late_p50_s" in result.speed:
        late = [f"{q} {1e3 * result.speed[f'late_{q}_s']:.2f} ms" for q in ("p50", "p99", "max")]
        yield f"  real time: late by {', '.join(late)}; {result.speed['overruns']:.0f} overruns"
    names = sorted(p.name for p in folder.iterdir() if p.is_file())
    yield f"  {folder}: {' '.join(names)}"


def _shift_line(shift: Shift) -> str:
    """Return time, impacts and lags of a shift."""
    took_s = shift.shift_time_s
    took = "never arrived" if took_s is None else f"{1e3 * took_s:.0f} ms from request to stop"
    line = f"{shift.from_gear} to {shift.to_gear}: {took}"
    if shift.impact_speed_m_s is not None and shift.impact_energy_j is not None:
        line += f", impact {shift.impact_speed_m_s:.2f} m/s ({shift.impact_energy_j:.1f} J)"
    worst = max(shift.impacts, key=lambda impact: impact.energy_j, default=None)
    if worst is not None and worst.name != "stay_stop":
        figures = f"{worst.energy_j:.2f} J, {1e-3 * worst.peak_force_n:.1f} kN"
        line += f"; hardest impact: {worst.name.replace('_', ' ')}, {figures}"
    if shift.confirmed_early_s:
        line += f"; CONFIRMED {1e3 * shift.confirmed_early_s:.0f} ms BEFORE IT ARRIVED"
    if shift.position_lag_10_s is not None and shift.position_lag_90_s is not None:
        early, late = 1e3 * shift.position_lag_10_s, 1e3 * shift.position_lag_90_s
        line += f"; controller's position late by {early:.0f} ms at 10 %, {late:.0f} ms at 90 % of travel"
    return line
