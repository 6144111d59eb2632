"""report.html of a truck's log: a table, a picture per shift, and one of all.

Checked by: tests/unit/sil/replay/test_truck_page.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from sil.files.progress import Progress
from sil.replay import truck_replay as replays
from sil.replay.truck_loop import OurShift
from sil.replay.truck_replay import ComparedShift, TruckReplay
from sil.replay.truck_shift import NAMES, PHASES
from sil.report.figure import MM, Figure, Panel, Rule, Series, Span, Stack
from sil.report.picture import save
from sil.report.plots import Group, plots
from sil.report.shell import Head, Picture, render

ROLES: Final = ("truth", "after", "before")
"""Colours of the recorded side, of ours, and of ours as changed."""

PHASE_ROLES: Final = dict(zip(PHASES, ("INIT", "N", "HOLD", "B", "CONFIRM"), strict=True))
MOST_NAMED: Final = 24
"""Shifts that are named below the picture of all; more are numbered."""

TEXTS_APART_S: Final = 0.03
"""Instants nearer than this have one text in a picture."""

MOST_PLOTS: Final = 12
"""Shifts with interactive plots on the page, the first ones."""

MOST_PICTURES: Final = 40
"""On the page; those of further shifts are files in the folder."""


CAPTION: Final = "Recorded side and ours after the request; the engine's torque is the truck's."


def truck_page(replay: TruckReplay, values: dict[str, Any], command: str, folder: Path) -> str:
    """Return the page, its pictures written into the folder; `values` is what diff.json holds."""
    overview = save(_summary_figure(replay), folder, "shifts")
    alt = "Time from request to new gear of each shift, recorded and ours"
    caption = "Request to new gear of each shift. Shaded: not in the statistics."
    pictures: list[Picture] = []
    groups: list[Group] = []
    with Progress("pictures") as progress:
        for count, shift in enumerate(replay.shifts, start=1):
            figure = shift_figure(replay, shift)
            png = save(figure, folder, f"shift_{shift.number}")
            if len(groups) < MOST_PLOTS:
                groups += plots(figure)
            if len(pictures) < MOST_PICTURES:
                words = f"Shift {shift.title}: recorded and ours on one time axis"
                pictures.append(Picture(png, words, CAPTION))
            progress(count, len(replay.shifts))
    less, same, more = replays.quicker(replay, 0)
    tiles = [
        (f"{len(replay.shifts)}", "shifts recorded"),
        (f"{less}", "ours quicker"),
        (f"{same}", "as quick"),
        (f"{more}", "ours slower"),
        (f"{len(replay.failed)}", "not reached by ours"),
    ]
    head = Head(
        command="replay",
        name=replay.log.path,
        verdict="a gear not reached" if replay.failed else "",
        good=False if replay.failed else None,
        tiles=tiles,
        again=command,
    )
    return render(
        "truck.html",
        head,
        groups,
        diff=values,
        names=NAMES,
        overview=Picture(overview, alt, caption),
        pictures=pictures,
        hidden=max(0, len(replay.shifts) - MOST_PICTURES),
    )


def _summary_figure(replay: TruckReplay) -> Figure:
    """Return the time to the new gear of every shift, by column."""
    series, spans = [], []
    for column, name in enumerate(replays.columns_of(replay)):
        times = [
            (shift.number, replays.side_figures(shift, column)["request to new gear"])
            for shift in replay.shifts
            if not shift.skipped
        ]
        known = np.array([(n, t) for n, t in times if t is not None], dtype=np.float64)
        if len(known):
            series.append(Series(name, known[:, 0], known[:, 1], ROLES[column], "dots", width=4.0))
    for shift in replay.shifts:
        if not shift.counts:
            spans.append(Span(shift.number - 0.4, shift.number + 0.4, "grid"))
    panel = Panel("Request to new gear", "s", series, spans=spans, height=260)
    ticks = [(shift.number, shift.title) for shift in replay.shifts]
    few = ticks if len(ticks) <= MOST_NAMED else ()
    return Figure([Stack("shift", [panel], ticks=few, width=10.0)], "All shifts of the log")


def shift_figure(replay: TruckReplay, shift: ComparedShift) -> Figure:
    """Return speeds, torque, position and phases of a shift, recorded and ours."""
    recorded = shift.recorded
    names = replays.columns_of(replay)
    end_s = max([recorded.end_s, *(o.times_s["engaged"] or 0.0 for o in shift.ours)]) + 0.4
    cut = recorded.times_s["torque_cut"]
    instants = [(0.0, "request")] + ([] if cut is None else [(cut, "torque cut: our request")])
    if cut is not None and abs(cut) < TEXTS_APART_S:
        instants = [(0.0, "request, torque cut: our request")]
    rules = [Rule(at) for at, _ in instants]
    panels = []
    speeds = _speeds(shift, names)
    if speeds:
        named = [Rule(at, name) for at, name in instants]
        panels.append(Panel("Speed difference at the synchronizer", "rad/s", speeds, rules=named))
    torque = recorded.signals["engine_torque_share"]
    if torque is not None:
        line = Series("engine torque", torque.time_s, 100.0 * torque.values, ROLES[0], "stepped")
        panels.append(Panel("Engine torque, recorded", "%", [line], rules=rules, height=110))
    stays = [
        Series(names[k], ours.time_s, MM * ours.position_m, ROLES[k])
        for k, ours in enumerate(shift.ours, start=1)
    ]
    if stays:
        panels.append(Panel("Our stay", "mm", stays, rules=rules, height=130))
    sides = [recorded.times_s, *(ours.times_s for ours in shift.ours)]
    spans = [
        span for k, times in enumerate(sides) for span in _phase_spans(times, len(sides) - 1 - k)
    ]
    ticks = [(len(sides) - 0.5 - k, name) for k, name in enumerate(names[: len(sides)])]
    keys = [(f"to {NAMES[phase]}", PHASE_ROLES[phase]) for phase in PHASES]
    limits = (0.0, float(len(sides)))
    panels.append(
        Panel("Phases", spans=spans, ticks=ticks, keys=keys, height=40 * len(sides), limits=limits)
    )
    stack = Stack("time after the request, s", panels, limits=(-0.4, end_s), width=10.0)
    return Figure([stack], f"Shift {shift.title}", replays.verdict(shift)[0])


def _speeds(shift: ComparedShift, names: list[str]) -> list[Series]:
    sync = shift.recorded.synchronisation
    if sync is None:
        return []
    found = [Series(names[0], sync.time_s, sync.difference_rad_s, ROLES[0], width=2.4)]
    for k, ours in enumerate(shift.ours, start=1):
        found.append(Series(names[k], ours.time_s, _referred(ours), ROLES[k]))
    return found


def _referred(ours: OurShift) -> np.ndarray:
    """Return our difference [n], in rad/s, NaN before the gear is left: it refers to the next gear."""
    left = ours.times_s["disengaged"]
    if left is None:
        return ours.difference_rad_s
    return np.where(ours.time_s > left + 0.01, ours.difference_rad_s, np.nan)


def _phase_spans(times_s: dict[str, float | None], lane: int) -> list[Span]:
    """Return a rectangle per phase that is known, from the instant before it that is known."""
    spans, begin = [], 0.0
    for phase in PHASES:
        at = times_s[phase]
        if at is not None and at >= begin:
            spans.append(Span(begin, at, PHASE_ROLES[phase], "", lane + 0.1, lane + 0.9))
            begin = at
    return spans
