"""One run of a scenario: participants, bus and recorder put together, run, and judged."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from can_dbc.errors import InputError, RunError, os_error_text
from can_dbc.messages import Gear
from plant.trace import trace_columns
from sil.coupling.bus import BusFrame
from sil.coupling.clock import to_ns, to_seconds
from sil.coupling.faults import FaultPlan
from sil.coupling.lockstep import Lockstep, RunSummary
from sil.coupling.real_time import Pacer
from sil.coupling.transports.channel import silent
from sil.files.atomic import open_atomically, write_atomically
from sil.files.progress import Progress
from sil.firmware.cost import COST, cost_metrics, read_cost, write_cost
from sil.recording.end_to_end import EndToEnd
from sil.recording.recorder import (
    BUS_FRAMES,
    BUS_LOG,
    CLOCK_ZERO,
    EVENTS,
    PLANT_TRACE,
    BusLog,
    EventLog,
    FrameWriter,
    TraceWriter,
    trace_sha256,
)
from sil.recording.run_reader import RunReader
from sil.recording.run_record import RunRecord
from sil.recording.trace_csv import TraceCsv
from sil.rules import Rule
from sil.rules.shipped import RULES
from sil.simulation import build, metrics
from sil.simulation.build import SCENARIO, SENDERS, Say
from sil.simulation.bus_figures import bus_figures, overload
from sil.simulation.circumstances import circumstances
from sil.simulation.judgement import Observed, judge
from sil.simulation.load_scenario import Loaded
from sil.simulation.loop import Loop
from sil.simulation.results import Check, Result, versions, write_result
from sil.simulation.scenario import Scenario, contradictions, expanded

if TYPE_CHECKING:
    from sil.simulation.free_run import FreeRun


@dataclass(frozen=True)
class Finished:
    """A run that has ended. `record`: of one longer than `PIECE_S` its first piece; None: nothing recorded."""

    result: Result
    record: RunRecord | None
    shifts: list[metrics.Shift]


def run(
    loaded: Loaded,
    folder: Path,
    *,
    transport: str = "inproc",
    speed: float | None = None,
    free_running: bool = False,
    external: Collection[str] = (),
    rules: Sequence[Rule] = RULES,
    say: Say = silent,
) -> Finished:
    """Run a scenario into an empty folder and write everything but pictures there.

    `speed`: simulated seconds per wall second of a paced lockstep; None: as fast as possible. `rules`: what
    the run is held to. `free_running`: no lockstep, every node by its own clock. A run that ends early is
    written too, marked incomplete with the reason, also one that is killed.
    Raises InputError if scenario or transport is not valid (the folder is then empty), RunError if a
    participant cannot be started, KeyboardInterrupt when all is written.
    """
    scenario = loaded.scenario
    begun = time.perf_counter()
    pacer = None if speed is None else Pacer(speed)
    plan = FaultPlan(scenario.fault, scenario.seed)
    bus = build.make_bus(scenario, plan)
    free: FreeRun | None = None
    lockstep: Lockstep | None = None
    summary: RunSummary | None = None
    why: str | None = None
    interrupt: KeyboardInterrupt | None = None
    log: BusLog | None = None
    try:
        with contextlib.ExitStack() as closing:
            base = _begin(loaded, folder, transport)
            arguments = (loaded, folder, transport, external, say, closing)
            if free_running:  # python-can, whose import takes as long as a short run
                from sil.simulation.free_run import FreeRun

                free = FreeRun(*arguments)
            else:
                channels = build.open_channels(*arguments)
            log = BusLog(folder / BUS_LOG)
            closing.callback(log.close)
            frames = closing.enter_context(FrameWriter(folder / BUS_FRAMES, SENDERS))
            progress = closing.enter_context(Progress(scenario.name, "s simulated"))

            def record(deliveries: list[BusFrame]) -> None:
                log.record(deliveries)
                frames.record(deliveries)
                progress(to_seconds(deliveries[-1].arrival_ns), scenario.duration_s)

            if free is not None:
                summary = free.run(record)
            else:
                end_ns, outages = to_ns(scenario.duration_s), plan if scenario.fault else None
                how: dict[str, Any] = {"outages": outages, "pacer": pacer, "order": SENDERS}
                lockstep = Lockstep(bus, channels, end_ns, record=record, **how)
                summary = closing.enter_context(lockstep).run()
    except InputError:
        _discard(folder)
        raise
    except (RunError, KeyboardInterrupt, OSError) as error:  # OSError: disk full and the like
        if log is None:
            _discard(folder)
            raise
        why = _reason(error, loaded, folder, bool(log.frames))
        interrupt = error if isinstance(error, KeyboardInterrupt) else None
    source = free or lockstep
    for warning in source.warnings if source is not None and summary is not None else ():
        say(warning)
    bus_result = bus_figures(scenario, bus, plan) if free is None else free.figures()
    finished = _judge(loaded, folder, base, why, log, bus_result, summary, begun, rules, say)
    if interrupt is not None:
        raise interrupt
    return finished


def resume(loop: Loop, folder: Path) -> Finished:
    """Run a saved loop to its end and write the whole run. Raises InputError and RunError as `run` does."""
    loaded, scenario = loop.loaded, loop.loaded.scenario
    begun = time.perf_counter()
    base = _begin(loaded, folder, "inproc")
    summary: RunSummary | None = None
    why: str | None = None
    try:
        summary = loop.finish()
    except RunError as error:
        why = str(error)
    if (node := build.firmware_in_c(loop.participants)) is not None:
        write_cost(node.cost(), folder)
    columns = trace_columns(scenario.plant.drive)
    with (
        BusLog(folder / BUS_LOG) as log,
        FrameWriter(folder / BUS_FRAMES, SENDERS) as frames,
        TraceWriter(folder / PLANT_TRACE, columns) as trace,
        EventLog(folder / EVENTS) as events,
    ):
        log.record(loop.frames)
        frames.record(loop.frames)
        for rows in loop.trace:
            trace.write(rows)
        for event in loop.events:
            events(event.time_s, event.name, event.values)
    bus = bus_figures(scenario, loop.bus, loop.plan)
    return _judge(loaded, folder, base, why, log, bus, summary, begun)


def _begin(loaded: Loaded, folder: Path, transport: str) -> Result:
    """Write the scenario, and a result.json marked as incomplete; return the result so far."""
    scenario = loaded.scenario
    base = Result(
        scenario_name=scenario.name,
        seed=scenario.seed,
        transport=transport,
        versions=versions(),
        scenario=expanded(scenario),
        model={path: loaded.parameters[path].value for path in loaded.parameters},
    )
    write_result(replace(base, why="the run was cut off before it could say why"), folder)
    write_atomically(folder / SCENARIO, json.dumps({"scenario": base.scenario}, indent=1))
    return base


def _reason(error: BaseException, loaded: Loaded, folder: Path, has_frames: bool) -> str:
    """Return why a run ended early. Raises InputError for input that a participant refused at the start."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, OSError):
        return os_error_text(error)
    why = str(error)
    if said := re.match(r"\w+ ended with exit status (?P<code>[23]): opc4 node: ", why):
        why = why[said.end() :].replace(str(folder / SCENARIO), loaded.source)
        if said["code"] == "2" and not has_frames:
            _discard(folder)
            raise InputError(why) from None
    return why


def _discard(folder: Path) -> None:
    """Remove what a run that could not begin has put into its folder."""
    records = (BUS_LOG, BUS_FRAMES, PLANT_TRACE, EVENTS)
    for name in (SCENARIO, *records, CLOCK_ZERO, COST, "result.json"):
        (folder / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty: it was there before us
        folder.rmdir()


def _judge(
    loaded: Loaded,
    folder: Path,
    base: Result,
    why: str | None,
    log: BusLog,
    bus: dict[str, Any],
    summary: RunSummary | None,
    begun: float,
    rules: Sequence[Rule] = RULES,
    say: Say = silent,
) -> Finished:
    """Compute metrics and checks from the recorded run; write result.json and trace.csv."""
    scenario, cost = loaded.scenario, read_cost(folder)
    record: RunRecord | None = None
    shifts: list[metrics.Shift] = []
    checks: list[Check] = []
    figures, balances = dict[str, Any](), dict[str, Any]()
    warnings = [*contradictions(scenario), *overload(bus)]
    for line in warnings:
        say(f"warning: {line}")
    recorded = None
    if (folder / PLANT_TRACE).exists():
        constants, period_s = build.constants(loaded), scenario.trace_period_s
        recorded = RunReader(folder, SENDERS, constants=constants, trace_period_s=period_s)
    try:
        if recorded is not None and recorded.rows > 1:
            path = folder / "trace.csv"
            observed, shifts, switchings, checked = _figures(scenario, rules, recorded, path)
        else:
            recorded = None
    except OSError as error:  # no room for trace.csv: plant.trace stays instead
        recorded, why = None, why or os_error_text(error)
    if recorded is not None:
        bus["end_to_end"] = checked.counts()
        record, balances = recorded.first, dict(recorded.balances)
        figures = metrics.summary(shifts, balances.get("air_in_kg"), switchings, log.frames)
        figures |= cost_metrics(cost)
        if why is None:
            checks = judge(loaded, observed, shifts, figures, balances, bus)
    if why is None and record is None:
        why = f"the plant recorded nothing in {folder}; expected opc4 node plant --out {folder}"
    complete = why is None and summary is not None
    passed = complete and all(c.passed for c in checks)
    speed: dict[str, float] = {"wall_s": time.perf_counter() - begun}
    if summary is not None:
        speed |= {
            "loop_wall_s": summary.wall_s,
            "simulated_per_wall": scenario.duration_s / summary.wall_s,
            "turns": summary.turns,
        }
        if summary.lateness is not None:
            late = summary.lateness
            speed |= {f"late_{q}_s": getattr(late, f"{q}_s") for q in ("p50", "p99", "max")}
            speed["overruns"] = late.overruns
    result = replace(
        base,
        warnings=warnings,
        passed=passed,
        complete=complete,
        why=why,
        expectations=checks,
        metrics=figures,
        trace_sha256=trace_sha256(log.digest(), folder / PLANT_TRACE) if complete else None,
        bus=bus,
        balances=balances,
        firmware=cost,
        speed=speed,
        status="passed" if passed else "failed" if complete else "incomplete",
    )
    (folder / BUS_FRAMES).unlink(missing_ok=True)
    write_result(result, folder)
    if record is not None:
        (folder / PLANT_TRACE).unlink()
    (folder / SCENARIO).unlink()
    return Finished(result, record, shifts)


def _figures(
    scenario: Scenario, rules: Sequence[Rule], recorded: RunReader, path: Path
) -> tuple[Observed, list[metrics.Shift], int, EndToEnd]:
    """Write the trace of a run, and collect observations and shifts, piece by piece."""
    observed, checked = Observed(circumstances(scenario), rules=rules), EndToEnd()
    gear, switchings = build.gear_of(scenario.initial_gear), 0
    changes: list[tuple[float, Gear, Gear]] = []
    with open_atomically(path) as file:
        csv = TraceCsv(file)
        for piece in recorded:
            csv.add(piece)
            observed.add(piece)
            checked.add(piece)
            switchings += metrics.valve_switchings(piece)
            changes += metrics.requests(piece, changes[-1][2] if changes else gear)
    spans = metrics.spans(changes, recorded.end_s)
    shifts = [metrics.shift_figures(recorded.span(each[0], each[-1]), *each) for each in spans]
    return observed, shifts, switchings, checked
