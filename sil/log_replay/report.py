"""What a replay found: as lines, diff.txt, diff.json and report.html; also of trucks and their shifts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from statistics import median
from typing import Any, cast

from sil.files.output_folder import finite
from sil.files.progress import Progress
from sil.files.quantity import counted, noun
from sil.j1939.summary import J1939Summary
from sil.log_replay import figures
from sil.log_replay.comparison import Difference, StateHistory
from sil.log_replay.excerpts import waveforms
from sil.log_replay.replay import ReplayResult
from sil.log_replay.truck_replay import (
    ComparedShift,
    TruckReplay,
    quicker,
    statistics,
    truck_verdict,
)
from sil.log_replay.truck_shift import PHASES
from sil.report.figure import Panel
from sil.report.picture import save
from sil.report.plots import PlotGroup, plots
from sil.report.run_figure import with_faults
from sil.report.shell import Head, Picture, render
from sil.simulation.safety import fault_spans

MOST_STATES_SHOWN = 60


@dataclass(frozen=True)
class Report:
    """A replay as it is reported. page: takes the call and the folder of the pictures."""

    lines: list[str]
    text: str
    values: dict[str, Any]
    page: Callable[[str, Path], str]


def report(outcome: ReplayResult | TruckReplay) -> Report:
    """Report a replay of our own unit's log or of a truck's."""
    if isinstance(outcome, TruckReplay):
        values = truck_dict(outcome)
        truck = partial(truck_page, outcome, values)
        return Report(truck_lines(outcome), truck_text(outcome), values, truck)
    values = as_dict(outcome)
    page = partial(replay_page, outcome, values)
    return Report(summary_lines(outcome), text(outcome), values, page)


def verdict(outcome: ReplayResult) -> str:
    """Return the one line that says it all."""
    comparison = outcome.comparison
    if not comparison.differs:
        text = f"no difference in {counted(comparison.ticks, 'tick')}"
        if outcome.request.reference is not None:
            text += f" between the firmware here and that of {outcome.labels[0]}"
    else:
        signals = sum(1 for entry in comparison.signals.values() if entry.differing)
        text = f"{comparison.differing_ticks} of {counted(comparison.ticks, 'tick')} differ, in {counted(signals, 'signal')}"
        if outcome.tried:
            which = "the defaults do" if outcome.tried == 1 else f"{outcome.tried} shipped ones do"
            text = (
                f"nothing says which settings the recorded firmware had, and {which} not give its commands, so they "
                "cannot be compared; expected its result.json or scenario, by --run or --firmware, or --set. "
                f"With the defaults {text}"
            )
    if outcome.plant is not None and outcome.request.plant:
        text += f"; {attribution(outcome)}"
    return text


def attribution(outcome: ReplayResult) -> str:
    """Say which side differs from the recording."""
    assert outcome.plant is not None
    unit, plant = outcome.comparison.differs, outcome.plant.differing > 0
    by_default = " (as set by default: --run gives the run's own settings)"
    source = "" if outcome.settings.own_run else by_default
    if plant and unit:
        return f"both the control unit and the plant{source} differ from the recording"
    if plant:
        return f"the control unit answers as recorded, the plant{source} does not: the difference is the plant's"
    if unit:
        return "the plant answers as recorded, the control unit does not: the difference is the control unit's"
    return "the plant answers as recorded, too"


def edge_lines(outcome: ReplayResult) -> list[str]:
    """Say which edges moved, are gone or new."""
    period_ns, origin_ns = outcome.grid.period_ns, outcome.grid.origin_ns
    edges = outcome.comparison.matched_edges()
    return [line for matched in edges for line in matched.lines(period_ns, origin_ns)]


def summary_lines(outcome: ReplayResult) -> list[str]:
    """Return what is printed: verdict, edges, where the sides part, what was special."""
    lines = edge_lines(outcome)
    lines += [_sequences(h, outcome.labels) for h in outcome.comparison.states if h.differs]
    first = outcome.comparison.first
    if first is not None:
        (a, b), (name, x, y) = outcome.labels, first.signals[0]
        more = f", and {len(first.signals) - 1} more" if len(first.signals) > 1 else ""
        when = _when(outcome, first.time_ns)
        lines.append(f"first difference at {when}: {name} {a} {x}, {b} {y}{more}")
    if outcome.plant is not None:
        lines += plant_lines(outcome)
    lines.append(f"firmware {outcome.settings.description}; {outcome.grid.description}")
    lines += [_account_line(outcome), *outcome.notes]
    return [f"{outcome.request.log}: {verdict(outcome)}", *_indented(lines)]


def text(outcome: ReplayResult) -> str:
    """Return diff.txt."""
    grid, comparison = outcome.grid, outcome.comparison
    total = sum(len(signal.recorded) for signal in comparison.switches)
    lines = [
        f"replay of {outcome.request.log}",
        f"firmware  {outcome.settings.description}",
        f"grid      {grid.description}",
        f"verdict   {verdict(outcome)}",
        "",
        "edges",
        *_indented(edge_lines(outcome) or [f"none of {total} moved"]),
        "",
        "states",
    ]
    for history in comparison.states:
        lines += _indented([_sequences(history, outcome.labels)])
    lines += ["", *_difference_lines(outcome, "first difference", comparison.first)]
    if comparison.first_command is not None and comparison.first_command != comparison.first:
        lines += _difference_lines(outcome, "first command that differs", comparison.first_command)
    if outcome.plant is not None:
        lines += ["plant", *_indented(plant_lines(outcome)), ""]
    for scene in comparison.excerpts.excerpts:
        lines.append(f"waveforms, commands {'differ' if scene.differs else 'are equal'}")
        lines += _indented(waveforms(scene, outcome.labels, grid.origin_ns))
    lines += ["signals", *_indented(_signal_lines(outcome)), ""]
    lines += ["frames", *_indented([_account_line(outcome)])]
    if outcome.notes:
        lines += ["", "notes", *_indented(outcome.notes)]
    return "\n".join(lines) + "\n"


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"  {line}".rstrip() for line in lines]


def as_dict(outcome: ReplayResult) -> dict[str, Any]:
    """Return diff.json; times in s on the log's clock."""
    grid, comparison = outcome.grid, outcome.comparison
    base_ns = grid.origin_ns
    return {
        "format": 1,
        "log": outcome.request.log,
        "differs": outcome.differs,
        "verdict": verdict(outcome),
        "sides": list(outcome.labels),
        "firmware": outcome.settings.description,
        "grid": {
            "origin_s": base_ns / 1e9,
            "period_s": grid.period_ns / 1e9,
            "computation_s": grid.computation_ns / 1e9,
            "bitrate": grid.bitrate,
            "exact": grid.exact,
            "text": grid.description,
        },
        "ticks": comparison.ticks,
        "differing_ticks": comparison.differing_ticks,
        "warm_up_ticks": comparison.warm_up_ticks,
        "edges": [
            result.as_dict(base_ns) | {"text": result.lines(grid.period_ns, base_ns)}
            for result in comparison.matched_edges()
        ],
        "states": [history.as_dict(base_ns) for history in comparison.states],
        "first": comparison.first and comparison.first.as_dict(base_ns),
        "first_command": comparison.first_command and comparison.first_command.as_dict(base_ns),
        "signals": {
            name: entry.as_dict(base_ns) for name, entry in sorted(comparison.signals.items())
        },
        "plant": outcome.plant
        and outcome.plant.as_dict(base_ns)
        | {"attribution": attribution(outcome) if outcome.request.plant else None},
        "frames": {
            "total": outcome.frames,
            "accounted": outcome.account.total(),
            "uses": dict(outcome.account),
            "unanswered": dict(outcome.unanswered),
        },
        "log_report": outcome.read.as_dict(),
        "notes": outcome.notes,
    }


def _when(outcome: ReplayResult, time_ns: int) -> str:
    return f"{(time_ns + outcome.grid.origin_ns) / 1e9:.6f} s"


def _difference_lines(outcome: ReplayResult, title: str, parting: Difference | None) -> list[str]:
    if parting is None:
        return [f"{title}: none", ""]
    a, b = outcome.labels
    return [
        f"{title} at {_when(outcome, parting.time_ns)}",
        *(f"  {name}: {a} {x}, {b} {y}" for name, x, y in parting.signals),
        "  inputs that led there",
        *(f"    {line}" for line in parting.inputs),
        "",
    ]


def _sequences(history: StateHistory, labels: tuple[str, str]) -> str:
    recorded, replayed = history.sequence(0), history.sequence(1)
    if recorded == replayed:
        return f"{history.name}: the same {len(recorded)} in both: {_row(recorded)}"
    pairs = zip(recorded, replayed, strict=False)
    same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
    start = max(same - 2, 0)
    rows = f"{labels[0]} {_row(recorded[start:])}; {labels[1]} {_row(replayed[start:])}"
    return f"{history.name}: the same {same}, then {rows}"


def _row(names: list[str]) -> str:
    more = len(names) - MOST_STATES_SHOWN
    shown = " ".join(names[:MOST_STATES_SHOWN]) or "nothing"
    return f"{shown} ... and {more} more" if more > 0 else shown


def plant_lines(outcome: ReplayResult) -> list[str]:
    """Return how the plant compared, and when the loop was closed."""
    plant = outcome.plant
    assert plant is not None
    lines = []
    if outcome.request.plant:
        share = f"{plant.differing} of {plant.compared}"
        lines.append(f"plant alone on the recorded commands: {share} frames differ")
        if plant.unmatched:
            count = counted(plant.unmatched, "recorded frame")
            lines.append(f"{count} of the plant without a counterpart")
        lines += [f"{name}: at most {x:.6g} apart" for name, x in plant.largest.items()]
        if plant.first is not None:
            when, (name, a, b) = _when(outcome, plant.first.time_ns), plant.first.signals[0]
            lines.append(f"first at {when}: {name} recorded {a}, replayed {b}")
        lines.append(attribution(outcome))
    if plant.closed_ns is not None:
        when = _when(outcome, plant.closed_ns)
        lines.append(f"loop closed at {when}: from there the plant answers")
    elif outcome.request.closed_loop:
        lines.append("no command differs, so the loop stayed open")
    return lines


def _signal_lines(outcome: ReplayResult) -> list[str]:
    lines, signals = [], outcome.comparison.signals
    for name, entry in sorted(signals.items()):
        if entry.first_ns is not None:
            size = "" if entry.largest is None else f", at most {entry.largest:.6g} apart"
            share, when = f"{entry.differing} of {entry.compared}", _when(outcome, entry.first_ns)
            lines.append(f"{name}: {share} differ{size}, first at {when}")
    return [*lines, f"{counted(len(signals) - len(lines), 'signal')} without a difference"]


def _account_line(outcome: ReplayResult) -> str:
    parts = ", ".join(f"{count} {what}" for what, count in outcome.account.items())
    return f"{outcome.account.total()} of {counted(outcome.frames, 'frame')} accounted for: {parts}"


def replay_page(outcome: ReplayResult, values: dict[str, Any], command: str, folder: Path) -> str:
    """Return the page, its figures written into the folder; `command` is the call that made it."""
    states = [
        {
            "name": history.name,
            "side": label,
            "row": " ".join(history.sequence(side)[:MOST_STATES_SHOWN]) or "nothing",
        }
        for history in outcome.comparison.states
        for side, label in enumerate(outcome.labels)
    ]
    head = Head(
        command="replay",
        name=outcome.request.log,
        verdict="differs" if outcome.differs else "no difference",
        good=not outcome.differs,
        tiles=_tiles(outcome),
        again=command,
    )
    pictures, groups = _pictures(outcome, folder)
    return render(
        "replay.html",
        head,
        groups,
        diff=values,
        edges=edge_lines(outcome),
        pictures=pictures,
        states=states,
        plant=plant_lines(outcome) if outcome.plant is not None else [],
        account=_account_line(outcome),
    )


def _tiles(outcome: ReplayResult) -> list[tuple[str, str]]:
    results = outcome.comparison.matched_edges()
    alone = sum(len(r.matching.dropped) + len(r.matching.added) for r in results)
    shifts = [abs(s) for result in results for s in result.shift_ns]
    return [
        (f"{outcome.comparison.ticks}", "ticks compared"),
        (f"{outcome.comparison.differing_ticks}", "ticks that differ"),
        (f"{sum(len(result.signal.recorded) for result in results)}", "edges recorded"),
        (f"{sum(1 for s in shifts if s)}", "edges moved"),
        (f"{alone}", "edges gone or new"),
        (f"{max(shifts, default=0) / 1e6:g} ms", "farthest moved"),
        (f"{outcome.account.total()} of {outcome.frames}", "frames accounted for"),
    ]


def _pictures(outcome: ReplayResult, folder: Path) -> tuple[list[Picture], list[PlotGroup]]:
    """Return the pictures, each written into the folder, and the plots of the same figures."""
    base_ns = outcome.grid.origin_ns
    positions = outcome.plant.positions if outcome.plant is not None else []
    marks = _fault_marks(outcome)
    a, b = outcome.labels
    drawn = [
        figures.scene_figure(scene, (a, b), base_ns, positions, marks)
        for scene in outcome.comparison.excerpts.excerpts
    ]
    alt = "Position, coils and states of both sides over time"
    coils = f"the coils energised (pale: {a}, full: {b})"
    caption = f"The controller's estimate, {coils} and the states."
    pictures = [
        Picture(save(figure, folder, f"scene_{number}"), alt, caption)
        for number, figure in enumerate(drawn, start=1)
    ]
    return pictures, [group for figure in drawn for group in plots(figure)]


def _fault_marks(outcome: ReplayResult) -> Callable[[Panel], Panel]:
    """Return what marks the faults of the run in a panel, and when each side first reported one."""
    ready, base_s = outcome.settings, outcome.grid.origin_ns / 1e9
    scene = ready.loaded.scenario
    recorded, replayed = outcome.comparison.reported_ns
    both = dict(recorded.items() & replayed.items())
    reported = [(name, at_ns) for name, at_ns in recorded.items() if name in both]
    for label, side in zip(outcome.labels, (recorded, replayed), strict=True):
        reported += [(f"{label}: {name}", at) for name, at in side.items() if name not in both]
    begin_s = base_s if ready.free_running else 0.0
    return partial(
        with_faults,
        faults=fault_spans(scene) if ready.own_run else [],
        reported=[(base_s + at_ns / 1e9, name) for name, at_ns in reported],
        end_s=begin_s + scene.duration_s,
        begin_s=begin_s,
    )


def truck_lines(replay: TruckReplay) -> list[str]:
    """Return what the command prints: each shift in a line, then the statistics."""
    shifts, frames = counted(len(replay.shifts), "shift"), counted(replay.log.frames, "frame")
    lines = [f"{replay.log.path}: {shifts} in {frames} of a truck's log"]
    lines += [f"  {shift.title}: {truck_verdict(shift)[0]}" for shift in replay.shifts]
    for column, variant in enumerate(replay.variants):
        less, same, more = quicker(replay, column)
        name = f"{variant.name} ({variant.changes})" if variant.changes else variant.name
        shifts = counted(less, "shift")
        lines.append(f"{name}: quicker in {shifts}, as quick in {same}, slower in {more}")
    for row in statistics(replay):
        cells = [
            f"{name} {cell['median']:.3f} ({cell['p95']:.3f})"
            for name, cell in zip(replay.columns, row["columns"], strict=True)
            if cell["shifts"]
        ]
        if cells:
            lines.append(f"  {row['figure']}, {row['unit']}, median (95 %): {'; '.join(cells)}")
    return lines + [f"note: {note}" for note in replay.notes]


def truck_text(replay: TruckReplay) -> str:
    """Return diff.txt: the summary, then all of each shift."""
    lines = truck_lines(replay)
    for shift in replay.shifts:
        lines += ["", shift.title, f"  {shift.recorded.shift}"]
        lines += [f"  {line}" for line in truck_verdict(shift)]
        lines += [f"  note: {note}" for note in shift.recorded.notes]
        for path, value, source, reason in shift.inputs:
            number = value if isinstance(value, str) else f"{value:.6g}"
            lines.append(f"  {source}: {path} = {number} ({reason})")
    return "\n".join(lines) + "\n"


def truck_dict(replay: TruckReplay) -> dict[str, Any]:
    """Return diff.json; times of a shift in s after its request."""
    log = replay.log
    values = {
        "format": 1,
        "log": log.path,
        "kind": "truck",
        "frames": log.frames,
        "map": log.mapping.path,
        "dbc": log.mapping.dbc,
        "columns": replay.columns,
        "changes": [variant.changes for variant in replay.variants],
        "quicker_same_slower": [quicker(replay, k) for k in range(len(replay.variants))],
        "failed": [shift.number for shift in replay.failed],
        "statistics": statistics(replay),
        "shifts": [_shift_dict(shift) for shift in replay.shifts],
        "notes": replay.notes,
    }
    return cast("dict[str, Any]", finite(values))


def _shift_dict(shift: ComparedShift) -> dict[str, Any]:
    recorded, sync = shift.recorded, shift.recorded.synchronisation
    arrays = ("time_s", "position_m", "difference_rad_s")
    return {
        "number": shift.number,
        "title": shift.title,
        **recorded.shift.as_dict(),
        "request_ns": recorded.request_ns,
        "in_statistics": shift.counts,
        "skipped": shift.skipped,
        "recorded": {
            "times_s": recorded.times_s,
            "known_to_s": recorded.known_s,
            "peak_rad_s2": recorded.peak_rad_s2,
            "ratios": None if sync is None else [sync.old_ratio, sync.new_ratio],
            "signals": {name: s and s.origin for name, s in recorded.signals.items()},
        },
        "inputs": [entry._asdict() for entry in shift.inputs],
        "ours": [
            {name: value for name, value in vars(ours).items() if name not in arrays}
            for ours in shift.ours
        ],
        "verdict": [truck_verdict(shift, column) for column in range(max(len(shift.ours), 1))],
        "notes": recorded.notes,
    }


def truck_page(
    replay: TruckReplay, values: dict[str, Any], command: str, folder: Path, max_pictures: int = 40
) -> str:
    """Return the page of a truck's shifts, its pictures written into the folder.

    Pictures beyond `max_pictures` are files in the folder only; 12 shifts can be zoomed.
    """
    alt = "Time from request to new gear of each shift, recorded and ours"
    caption = "Request to new gear of each shift. Shaded: not in the statistics."
    overview = Picture(save(figures.all_shifts_figure(replay), folder, "shifts"), alt, caption)
    caption = "Recorded side and ours after the request; the engine's torque is the truck's."
    pictures: list[Picture] = []
    groups: list[PlotGroup] = []
    with Progress("pictures") as progress:
        for count, shift in enumerate(replay.shifts, start=1):
            figure = figures.shift_figure(replay, shift)
            png = save(figure, folder, f"shift_{shift.number}")
            if len(groups) < 12:
                groups += plots(figure)
            alt = f"Shift {shift.title}: recorded and ours on one time axis"
            pictures.append(Picture(png, alt, caption))
            progress(count, len(replay.shifts))
    less, same, more = quicker(replay, 0)
    head = Head(
        command="replay",
        name=replay.log.path,
        verdict="a gear not reached" if replay.failed else "",
        good=False if replay.failed else None,
        tiles=[
            (f"{len(replay.shifts)}", "shifts recorded"),
            (f"{less}", "ours quicker"),
            (f"{same}", "as quick"),
            (f"{more}", "ours slower"),
            (f"{len(replay.failed)}", "not reached by ours"),
        ],
        again=command,
    )
    return render(
        "truck.html",
        head,
        groups,
        diff=values,
        names=PHASES,
        overview=overview,
        pictures=pictures[:max_pictures],
        hidden=len(pictures[max_pictures:]),
    )


def shifts_page(summary: J1939Summary, log: str, command: str, folder: Path) -> str:
    """Return the page of a summary, the overview and the first 12 shifts as pictures in the folder."""
    overview = figures.shift_times_figure(summary)
    caption = "Shift time of each shift over the time of the log."
    pictures = [Picture(save(overview, folder, "shifts"), "Shift times", caption)]
    groups = plots(overview)
    for number, shift in enumerate(summary.shifts[:12], start=1):
        if (figure := figures.engine_figure(summary, shift)) is not None:
            groups += plots(figure)
            image = save(figure, folder, f"shift_{number}")
            pictures.append(Picture(image, "Engine around the shift", f"Shift {number}: {shift}"))
    times_s = [shift.duration_s for shift in summary.shifts]
    head = Head(
        command="replay",
        name=log,
        verdict=counted(len(times_s), "shift"),
        tiles=[
            (f"{summary.frames}", noun(summary.frames, "frame")),
            (f"{len(times_s)}", noun(len(times_s), "shift")),
            (f"{median(times_s):.3f} s" if times_s else "none", "median shift time"),
        ],
        again=command,
    )
    return render("shifts.html", head, groups, lines=summary.lines()[1:], pictures=pictures)
