"""One replay of a log, from its path to what differs."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path

import msgspec

from can_dbc.errors import InputError
from can_dbc.messages import ShiftRequest, ValveCommand
from controller.node import ControllerNode
from sil.files.overrides import Settings
from sil.files.quantity import counted, html_table
from sil.firmware.load import firmware_node
from sil.log_replay.comparison import Comparison
from sil.log_replay.executor import ReplayExecutor, Unit
from sil.log_replay.options import ReplaySettings, find_settings, shipped_firmware
from sil.log_replay.plant_side import PlantSide
from sil.log_replay.recorded_frames import OWN_IDS, RecordedFrames, ids_of_database
from sil.log_replay.signals import Options
from sil.log_replay.tick_grid import HEAD_FRAMES, NOMINAL, Grid, Survey, make_grid, survey
from sil.log_replay.ticks import TickMap, map_ticks
from sil.logs import LogFrame, LogReport, Logs, open_logs

FORGOTTEN_M = 1e-6
"""What the filter still remembers of the motion before a replay begun in the middle, at most."""


@dataclass(frozen=True)
class ReplayRequest:
    """What to replay; see `opc4 replay --help`."""

    log: str
    firmware: str | None = None
    settings: Settings = field(default_factory=dict)
    options: Options = field(default_factory=Options)
    run: str | None = None
    dbc: str | None = None
    plant: bool = False
    closed_loop: bool = False
    reader: Logs | None = None
    """The log, opened; None: the one file `log`."""
    reference: tuple[Path, str] | None = None
    """Checkout and name of the control unit whose answers stand in for the recorded ones."""


@dataclass
class ReplayResult:
    """Everything that a replay found."""

    request: ReplayRequest
    settings: ReplaySettings
    grid: Grid
    ticks: TickMap
    comparison: Comparison
    account: Counter[str]
    read: LogReport
    frames: int
    steps: int
    unanswered: Counter[str]
    plant: PlantSide | None
    notes: list[str] = field(default_factory=list)
    tried: int = 0
    """How many settings were tried in vain where the log does not say which ones it has; else 0."""

    def _repr_html_(self) -> str:
        rows = [
            ("ticks compared", self.comparison.ticks),
            ("ticks that differ", self.comparison.differing_ticks),
            *(("note", note) for note in self.notes),
        ]
        return html_table(self.request.log, ("", ""), rows)

    @property
    def differs(self) -> bool:
        """Whether any side differs."""
        plant_differs = self.plant is not None and self.request.plant and self.plant.differing > 0
        return self.comparison.differs or plant_differs

    @property
    def labels(self) -> tuple[str, str]:
        """What the two sides are called."""
        reference = self.request.reference
        return ("recorded", "replayed") if reference is None else (reference[1], "here")


def replay(request: ReplayRequest) -> ReplayResult:
    """Replay a log; where nothing says which settings its firmware had, try the shipped ones.

    Raises InputError for a log that cannot be replayed, or without a shift.
    Checked by: tests/scenarios/test_replay.py
    """
    outcome = _replay(request)
    alone = request.reference is None and not request.plant and not request.closed_loop
    if not (outcome.settings.assumed and outcome.differs and alone):
        return outcome
    tried = shipped_firmware() if outcome.frames <= 200_000 else {}
    for name, path in tried.items():
        other = _replay(replace(request, firmware=path))
        if not other.differs:
            other.notes.append(f"settings found by trying the shipped ones: those of {name}")
            return other
    outcome.tried = len(tried) + 1
    return outcome


def _replay(request: ReplayRequest) -> ReplayResult:
    log = _Log(request)
    ready, grid = _timing(request, log)
    scene = ready.loaded.scenario
    config = scene.controller
    frames = log.frames()
    ticks = map_ticks(frames, grid)
    if not frames.kinds[ShiftRequest]:
        raise InputError(
            f"{request.log}: no ShiftRequest in it, so nobody asked the control unit for anything; "
            "expected a log of its bus"
        )
    if ticks.restarts and (request.plant or request.closed_loop):
        raise InputError(
            f"{request.log}: the recording has gaps ({len(ticks.restarts)}) in which the plant is unknown; "
            "expected a recording without gaps, or neither --plant nor --closed-loop"
        )
    receives = _receiving(ready, grid, ticks, "controller")
    with ExitStack() as stack:
        start = partial(firmware_node, scene.firmware) if scene.firmware else ControllerNode
        firmware = stack.enter_context(closing(Unit(partial(start, config))))
        reference = None
        if request.reference is not None:
            tree, name = request.reference
            make = partial(firmware_node, str(tree), config, name)
            reference = stack.enter_context(closing(Unit(make)))
        plant = _plant(request, ready, grid, _receiving(ready, grid, ticks, "plant"))
        executor = ReplayExecutor(ticks, firmware, config.period_ns, receives, plant, reference)
        options = _options(request.options, grid, ticks)
        comparison = Comparison(options, config.duty_closed, executor.inputs, not grid.fresh)
        frames = log.frames()
        executor.run(frames, comparison)
    executor.account.update(frames.counts)
    if not comparison.engaged:
        raise InputError(
            f"{request.log}: no valve was ever energised, in the recording or in the replay, so that "
            "agreement would mean nothing; expected a log with a shift"
        )
    outcome = ReplayResult(
        request=request,
        settings=ready,
        grid=grid,
        ticks=ticks,
        comparison=comparison,
        account=executor.account,
        read=log.reader.report,
        frames=frames.total,
        steps=executor.steps,
        unanswered=executor.unanswered,
        plant=plant,
    )
    if executor.moved_inputs:
        outcome.notes.append(
            f"{executor.moved_inputs} inputs within the jitter of a tick, counted as the recorded answers show"
        )
    outcome.notes += _notes(outcome, log, frames)
    return outcome


class _Log:
    """The log under replay: its head for the survey, and fresh readings of the whole."""

    def __init__(self, request: ReplayRequest) -> None:
        self._path = request.log
        self._ids = OWN_IDS if request.dbc is None else ids_of_database(request.dbc)
        self.reader = request.reader or open_logs([request.log])
        self.channel: str | None = None
        self.skew = (0, 0.0)
        """Time in ns from which the recorder's clock drifts from the control unit's, and the share."""
        self._beginning = self._read_beginning()

    def survey(self, bitrate: int | None = None, period_ns: int | None = None) -> Survey:
        """Look at the first frames."""
        return survey(list(self.frames(self._beginning)), bitrate, period_ns)

    def frames(self, entries: Iterable[LogFrame] | None = None) -> RecordedFrames:
        """Return the frames of these entries, or of a new reading of the whole log."""
        log = self.reader if entries is None else entries
        return RecordedFrames(log, self.channel, self._ids, self._path, self.skew)

    def _read_beginning(self) -> list[LogFrame]:
        """Read on to the first valve command, and some more; choose the channel."""
        valves = {can_id for can_id, kind in self._ids.items() if kind is ValveCommand}
        before: deque[LogFrame] = deque(maxlen=500)  # frames that the survey sees, too
        entries, first = iter(self.reader), None
        for entry in entries:
            first = first or entry
            before.append(entry)
            if entry.extended and entry.can_id in valves and not entry.remote and not entry.error:
                break
        else:
            raise InputError(
                f"{self._path}: no ValveCommand in it, so there is nothing to compare with; "
                "expected a log of the control unit's bus, or --summary for any other truck's"
            )
        frames = [*before, *islice(entries, HEAD_FRAMES)]
        if first is not frames[0]:
            frames.insert(0, first)
        if len({frame.channel for frame in frames}) > 1:
            channels = Counter(f.channel for f in frames if f.extended and f.can_id in valves)
            self.channel = channels.most_common(1)[0][0]
        return sorted(frames, key=lambda frame: frame.time_ns)


def _timing(request: ReplayRequest, log: _Log) -> tuple[ReplaySettings, Grid]:
    """Return the settings, and the ticks of the recorded control unit. Raises InputError without any."""
    log_head = log.survey()
    ready = find_settings(
        request.log,
        log_head,
        firmware=request.firmware,
        settings=request.settings,
        run=request.run,
        with_plant=request.plant or request.closed_loop,
    )
    scene = ready.loaded.scenario
    if log_head.skew and not ready.own_run:
        log.skew = (log_head.first_ns, log_head.skew)
        log_head = log.survey()
    if ready.free_running:
        log_head = log.survey(period_ns=ready.recorded_ns)
    elif log_head.bitrate is None and ready.own_run:
        log_head = log.survey(scene.bus.bitrate)
    period_ns = log_head.period_ns or ready.recorded_ns
    if abs(period_ns - ready.recorded_ns) <= NOMINAL * period_ns:
        period_ns = ready.recorded_ns
    if log_head.release_ns is None:
        raise InputError(
            f"{request.log}: the steps of the recorded control unit cannot be found; expected its valve commands "
            "and status at regular times"
        )
    computation_ns = scene.controller.computation_ns
    return ready, make_grid(log_head, period_ns, computation_ns, ready.free_running)


def _options(options: Options, grid: Grid, ticks: TickMap) -> Options:
    """Allow for the filter's memory where the replay began while the control unit was at work."""
    if grid.fresh and not ticks.restarts:
        return options
    tolerance = dict(options.tolerance)
    tolerance.setdefault("ControllerStatus.estimate_m", FORGOTTEN_M)
    return msgspec.structs.replace(options, tolerance=tolerance)


def _receiving(
    ready: ReplaySettings, grid: Grid, ticks: TickMap, node: str
) -> Callable[[int], bool]:
    """Return what says whether a node receives the frames of a time: the run's faults, else its silence."""
    from sil.coupling.faults import FaultPlan

    scene = ready.loaded.scenario
    if ready.own_run and grid.origin_ns == 0:
        plan = FaultPlan(scene.fault, scene.seed)
        return lambda time_ns: node not in plan.bus_off(time_ns)
    if node == "controller":
        return ticks.receives
    return lambda time_ns: True


def _plant(
    request: ReplayRequest, ready: ReplaySettings, grid: Grid, receives: Callable[[int], bool]
) -> PlantSide | None:
    if not (request.plant or request.closed_loop):
        return None
    from plant.node import PlantNode
    from sil.simulation.build import plant_config, warm_up

    warm_up(ready.loaded)
    scene = ready.loaded.scenario
    return PlantSide(
        PlantNode(plant_config(scene), ready.loaded.parameters),
        request.options,
        grid,
        closes=request.closed_loop,
        receives=receives,
    )


def _notes(outcome: ReplayResult, log: _Log, frames: RecordedFrames) -> list[str]:
    """Return what a reader must know of this log."""
    grid, ticks, comparison = outcome.grid, outcome.ticks, outcome.comparison
    notes = []

    def when(tick: int) -> str:
        return f"{grid.tick_ns(tick) / 1e9:.3f} s"

    for name, spans in (("did not run", ticks.idle), ("was off the bus", ticks.off_bus)):
        notes += [f"the control unit {name} from {when(a)} to {when(b)}" for a, b in spans[:5]]
        if len(spans) > 5:
            notes.append(f"the control unit {name} {len(spans) - 5} times more")
    if gaps := len(ticks.restarts):
        notes.append(f"gaps in the recording: {gaps}; the replay restarted after each")
    if outcome.plant is not None and (not grid.fresh or not outcome.settings.own_run):
        state = f"at rest, vented and in {outcome.settings.loaded.scenario.initial_gear}"
        notes.append(f"the plant starts {state}: the log holds no other state")
    if (frames.last_ns or 0) - grid.tick_ns(ticks.last) > 2 * grid.period_ns:
        last = f"the control unit's last frame is at {when(ticks.last)}"
        notes.append(f"{last}; later frames are not compared")
    if outcome.unanswered:
        missing = ", ".join(f"{n} {name}" for name, n in sorted(outcome.unanswered.items()))
        notes.append(f"replayed but not in the recording, not compared: {missing}")
    if comparison.warm_up_ticks:
        notes.append(
            f"{counted(comparison.warm_up_ticks, 'tick')} left out at the beginning, until the control unit "
            f"that starts now agreed with the one that was at work, its position to {FORGOTTEN_M:g} m"
        )
    for kind, count in comparison.damaged.items():
        notes.append(f"{count} {kind.__name__} with values outside the contract, not compared")
    if log.channel is not None:
        notes.append(f"channel {log.channel or '(unnamed)'}")
    if log.skew[1]:
        notes.append(
            f"the recorder's clock runs {1e6 * log.skew[1]:+.1f} ppm against the control unit's; times here "
            "are by the control unit's, from the log's first frame on"
        )
    if frames.reordered:
        late = counted(frames.reordered, "frame")
        notes.append(f"{late} out of order, taken as of the latest time before")
    if left_out := outcome.read.lockstep_line():
        notes.append(f"log: {left_out}")
    if not outcome.read.clean:
        notes += [f"log: {line}" for line in outcome.read.lines()[1:]]
    return notes
