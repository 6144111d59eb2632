"""What decides that a run passed: the one place for runs in memory, in files and of free-running nodes.

Checked by: tests/contracts/test_one_judgement.py
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from msgspec.structs import replace

from can_dbc.errors import RunError
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    ControllerStatus,
    Fault,
    Gear,
    PlantMotion,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from sil.files.quantity import unit_of
from sil.recording.run_record import CHAMBERS, PIECE_S, RunRecord
from sil.rules.rule import Circumstances, Rule, Violation, violations
from sil.rules.shipped import RULES
from sil.simulation import build
from sil.simulation.expectations import Expectations, GearName, Limits, Timing
from sil.simulation.load_scenario import Loaded
from sil.simulation.loop import Loop
from sil.simulation.metrics import Shift, gear_at
from sil.simulation.results import Check
from sil.simulation.scenario import Scenario

RULES_BROKEN = "rules broken"


def judge(
    loaded: Loaded,
    observed: Observed,
    shifts: Sequence[Shift],
    metrics: dict[str, Any],
    balances: Mapping[str, Any],
    bus: dict[str, Any],
) -> list[Check]:
    """Return all checks of a run that came to its end: it passed if each of them did.

    - frames on the bus, the last request answered, the table [expect], the rules of `sil/rules/shipped.py`
    - mass and energy of the plant are balanced, no frame came later than its worst case: `invariants`

    Limits for the lockstep do not judge nodes with clocks of their own. A run that ends early has no
    checks and did not pass: RunError in memory, `complete` false in result.json.
    """
    scenario = loaded.scenario
    request, expect = scenario.request, scenario.expect
    if "mode" in bus:
        timing = [each for each in expect.timing if not each.lockstep]
        expect = replace(expect, lockstep={}, timing=timing)
    last = request[-1].gear if request else None
    checks = evaluate(expect, observed, shifts, metrics, last, partial(_too_short, loaded))
    return checks + invariants(scenario, balances, bus)


class Observed:
    """What the expectations need of a run, collected piece by piece in order of time."""

    def __init__(
        self, circumstances: Circumstances, *records: RunRecord, rules: Sequence[Rule] = RULES
    ) -> None:
        self._circumstances = circumstances
        self._rules = rules
        self.violations: dict[str, Violation] = {}
        self.stroke_m = math.nan
        kinds = (ShiftRequest, ValveCommand, ControllerStatus, PlantMotion)
        self.counts: dict[type, int] = dict.fromkeys(kinds, 0)
        self.opened: set[str] = set()
        self.valves_off = True
        self.position_m = 0.0
        self.confirmed: Gear | None = None
        self.refuses = False
        self.faults = Fault.NONE
        self.visited: list[str] = []
        for record in records:
            self.add(record)

    def add(self, record: RunRecord) -> None:
        """Add the next piece of the run."""
        self.stroke_m = record.stroke_m
        for kind in self.counts:
            self.counts[kind] += sum(1 for _ in record.each(kind))
        if len(record.truth["time_s"]):
            valves = [record.truth[f"valve_{c}"] for c in CHAMBERS]
            self.opened |= {c for c, u in zip(CHAMBERS, valves, strict=True) if (u > 0.5).any()}
            self.valves_off = all(u[-1] < 0.5 for u in valves)
            self.position_m = float(record.truth["position_m"][-1])
        for _, message in record.of(ControllerStatus):
            self.confirmed = message.confirmed
            self.refuses = message.state is ShiftState.FAULT
            self.faults |= message.faults
            if message.state.name not in self.visited:
                self.visited.append(message.state.name)
        for violation in violations(record, self._circumstances, self._rules):
            self.violations.setdefault(violation.rule, violation)


def evaluate(
    wanted: Expectations,
    observed: Observed,
    shifts: Sequence[Shift],
    metrics: dict[str, Any],
    last_request: GearName | None = None,
    too_short: Callable[[], str] = str,
) -> list[Check]:
    """Return one Check per expectation, after those that the run did anything; last_request: the last gear."""
    least, visited = wanted.min_frames, observed.visited
    checks = [
        _check(f"{kind.__name__} frames on the bus", count, {"min": least}, count >= least)
        for kind, count in observed.counts.items()
    ]
    if wanted.valves_opened is None and last_request is not None:
        count = len(observed.opened)
        checks.append(_check("a valve opened", count, {"min": 1}, count > 0))
    if last_request and wanted.confirmed_gear is None and not wanted.unfinished:
        done = observed.confirmed == Gear[last_request.upper()]
        state, limit = "confirmed" if done else "refused", "confirmed or refused"
        if not (is_answered := done or observed.refuses):
            state = f"neither confirmed nor refused at the end{too_short()}"
        checks.append(_check(f"request for {last_request}", state, limit, is_answered))
    if wanted.final_gear is not None:
        gear = gear_at(observed.position_m, observed.stroke_m).name.lower()
        checks.append(_check("final gear", gear, wanted.final_gear))
    if wanted.confirmed_gear is not None:
        confirmed = None if observed.confirmed is None else observed.confirmed.name.lower()
        checks.append(_check("confirmed gear", confirmed, wanted.confirmed_gear))
    if wanted.confirmed_after_arrival:
        early_s = metrics["confirmed_early_s"]
        checks.append(Limits(max=0.0).check("confirmed before arrival", early_s, "s"))
    if wanted.faults is not None:
        names = sorted(f.name or "" for f in Fault if f and f in observed.faults)
        checks.append(_check("faults reported", names, sorted(wanted.faults)))
    if (off := wanted.valves_off_at_end) is not None:
        checks.append(_check("valves off at the end", observed.valves_off, off))
    if states := wanted.states:
        checks.append(_check("states visited", visited, states, {*states} <= {*visited}))
    if states := wanted.never_states:
        avoided = not {*states} & {*visited}
        checks.append(_check("states never entered", visited, states, avoided))
    if wanted.valves_opened is not None:
        expected = sorted(wanted.valves_opened, key=CHAMBERS.index)
        opened = sorted(observed.opened, key=CHAMBERS.index)
        checks.append(_check("valves opened", opened, expected))
    broken = [f"{v.rule} at {v.time_s:.3f} s: {v.text}" for v in observed.violations.values()]
    as_stated = set(observed.violations) == set(wanted.violated)
    checks.append(_check(RULES_BROKEN, broken, wanted.violated, as_stated))
    for name, limits in (*wanted.metrics.items(), *wanted.lockstep.items()):
        checks.append(limits.check(name, metrics.get(name), unit_of(name)))
    return checks + [_timing(t, shifts) for t in wanted.timing]


def _check(name: str, value: Any, limit: Any, passed: bool | None = None) -> Check:
    """Return a check of a value; without `passed`, it must be equal to the limit."""
    passed = value == limit if passed is None else passed
    return Check(name=name, passed=passed, value=value, limit=limit)


def _timing(wanted: Timing, shifts: Sequence[Shift]) -> Check:
    name = f"shift {wanted.shift}: {wanted.start} to {wanted.to}"
    shift = shifts[wanted.shift - 1] if wanted.shift <= len(shifts) else None
    start, end = (getattr(shift, f"{instant}_s", None) for instant in (wanted.start, wanted.to))
    value = None if start is None or end is None else end - start
    return Limits(wanted.min_s, wanted.max_s).check(name, value, "s")


def _too_short(loaded: Loaded) -> str:
    """Return by how much a run is too short for its last request, empty if no longer run can tell."""
    scenario, longer_s = loaded.scenario, 3.0
    last, end_s = scenario.request[-1], scenario.duration_s
    if scenario.bus.guest or end_s > PIECE_S:
        return ""
    longer = replace(scenario, duration_s=end_s + longer_s)
    loop = Loop(dataclasses.replace(loaded, scenario=longer))
    try:
        loop.finish()
    except RunError:
        return ""
    for entry, message in loop.record().of(ControllerStatus):
        late_s = entry.arrival_ns / NS_PER_S - end_s
        ends = message.confirmed == build.gear_of(last.gear) or message.state is ShiftState.FAULT
        if late_s > 0.0 and ends:
            return f"; the run is too short by {math.ceil(1e3 * late_s)} ms"
    return f"; not even {longer_s:g} s later"


def invariants(scenario: Scenario, balances: Mapping[str, Any], bus: dict[str, Any]) -> list[Check]:
    """Return what every run keeps besides the rules: balances; in lockstep, if no others send, worst cases."""
    state = {None: None, 1.0: "closed"}.get(balances.get("closed"), "open")
    checks = [_check("mass and energy balances", state, "closed")]
    if scenario.fault or scenario.bus.extra_load > 0.0 or scenario.bus.guest or "mode" in bus:
        return checks
    late = [
        message["name"]
        for message in bus["messages"]
        if (message["longest_response_s"] or 0.0) > (message["worst_case_s"] or 0.0)
    ]
    return [*checks, _check("frames later than their worst case", late, [])]
