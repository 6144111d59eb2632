"""What a replay found, as lines for a reader and as values for a program."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import takewhile
from typing import Any

from sil.files.quantity import counted
from sil.replay.comparison import Difference, StateHistory
from sil.replay.edges import shift_text
from sil.replay.excerpts import waveforms
from sil.replay.replay import ReplayResult

MOST_STATES_SHOWN = 60


def verdict(outcome: ReplayResult) -> str:
    """Return the one line that says it all."""
    found = outcome.comparison
    if not found.differs:
        text = f"no difference in {counted(found.ticks, 'tick')}"
        if outcome.request.reference is not None:
            text += f" between the firmware here and that of {outcome.labels[0]}"
    else:
        signals = sum(1 for entry in found.signals.values() if entry.differing)
        text = f"{found.differing_ticks} of {counted(found.ticks, 'tick')} differ, in {counted(signals, 'signal')}"
    if outcome.plant is not None and outcome.request.plant:
        text += f"; {attribution(outcome)}"
    return text


def attribution(outcome: ReplayResult) -> str:
    """Say which side differs from the recording."""
    assert outcome.plant is not None
    unit, plant = outcome.comparison.differs, outcome.plant.differing > 0
    by_default = " (as set by default: --run gives the run's own settings)"
    known = "" if outcome.settings.own_run else by_default
    if plant and unit:
        return f"both the control unit and the plant{known} differ from the recording"
    if plant:
        return (
            f"the control unit answers as recorded, the plant{known} does not: "
            "the difference is the plant's"
        )
    if unit:
        return "the plant answers as recorded, the control unit does not: the difference is the control unit's"
    return "the plant answers as recorded, too"


def edge_lines(outcome: ReplayResult) -> list[str]:
    """Say which edges moved, are gone or new."""
    grid = outcome.grid
    found = [r for r in outcome.comparison.matched_edges() if r.moved(0)]
    return [line for r in found for line in r.lines(grid.period_ns, grid.origin_ns)]


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
    grid, found = outcome.grid, outcome.comparison
    edges = edge_lines(outcome)
    total = sum(len(signal.recorded) for signal in found.switches)
    lines = [
        f"replay of {outcome.request.log}",
        f"firmware  {outcome.settings.description}",
        f"grid      {grid.description}",
        f"verdict   {verdict(outcome)}",
        "",
        "edges",
        *_indented(edges or [f"none of {total} moved"]),
        "",
        "states",
    ]
    for history in found.states:
        lines += _indented([_sequences(history, outcome.labels)])
        lines += _indented(_state_times(history, outcome), 4)
    lines += ["", *_difference_lines(outcome, "first difference", found.first)]
    if found.first_command is not None and found.first_command != found.first:
        lines += _difference_lines(outcome, "first command that differs", found.first_command)
    if outcome.plant is not None:
        lines += ["plant", *_indented(plant_lines(outcome)), ""]
    for scene in found.excerpts.found:
        lines.append(f"waveforms, commands {'differ' if scene.differs else 'are equal'}")
        lines += _indented(waveforms(scene, outcome.labels, grid.origin_ns))
    lines += ["signals", *_indented(_signal_lines(outcome)), "", "frames"]
    lines += _indented([_account_line(outcome), *account_lines(outcome)])
    if outcome.notes:
        lines += ["", "notes", *_indented(outcome.notes)]
    return "\n".join(lines) + "\n"


def _indented(lines: Iterable[str], width: int = 2) -> list[str]:
    return [f"{' ' * width}{line}".rstrip() for line in lines]


def as_dict(outcome: ReplayResult) -> dict[str, Any]:
    """Return diff.json; times in s on the log's clock."""
    grid, found = outcome.grid, outcome.comparison
    base_ns = grid.origin_ns
    account = outcome.account
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
        "ticks": found.ticks,
        "differing_ticks": found.differing_ticks,
        "warm_up_ticks": found.warm_up_ticks,
        "edges": [
            result.as_dict(base_ns) | {"text": result.lines(grid.period_ns, base_ns)}
            for result in found.matched_edges()
        ],
        "states": [_history(history, base_ns) for history in found.states],
        "first": _difference_dict(found.first, base_ns),
        "first_command": _difference_dict(found.first_command, base_ns),
        "signals": {
            name: {
                "compared": entry.compared,
                "differing": entry.differing,
                "largest": entry.largest,
                "first_s": None if entry.first_ns is None else (entry.first_ns + base_ns) / 1e9,
            }
            for name, entry in sorted(found.signals.items())
        },
        "plant": None
        if outcome.plant is None
        else outcome.plant.as_dict(base_ns)
        | {"attribution": attribution(outcome) if outcome.request.plant else None},
        "frames": {
            "total": outcome.frames,
            "accounted": account.total,
            **vars(account),
            "foreign_names": [{"name": name, "frames": count} for name, count in outcome.foreign],
            "unanswered": dict(outcome.unanswered),
        },
        "log_report": outcome.read.as_dict(),
        "notes": outcome.notes,
    }


def _when(outcome: ReplayResult, time_ns: int | None) -> str:
    assert time_ns is not None
    return f"{(time_ns + outcome.grid.origin_ns) / 1e9:.6f} s"


def _difference_lines(outcome: ReplayResult, title: str, parting: Difference | None) -> list[str]:
    if parting is None:
        return [f"{title}: none", ""]
    a, b = outcome.labels
    lines = [f"{title} at {_when(outcome, parting.time_ns)}"]
    lines += [f"  {name}: {a} {x}, {b} {y}" for name, x, y in parting.signals]
    lines += ["  inputs that led there", *(f"    {line}" for line in parting.inputs), ""]
    return lines


def _sequences(history: StateHistory, labels: tuple[str, str]) -> str:
    recorded, replayed = history.sequence(0), history.sequence(1)
    if recorded == replayed:
        return f"{history.name}: the same {len(recorded)} in both: {_row(recorded)}"
    both = zip(recorded, replayed, strict=False)
    same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], both))
    start = max(same - 2, 0)
    rows = f"{labels[0]} {_row(recorded[start:])}; {labels[1]} {_row(replayed[start:])}"
    return f"{history.name}: the same {same}, then {rows}"


def _row(names: list[str]) -> str:
    shown = " ".join(names[:MOST_STATES_SHOWN]) or "nothing"
    more = len(names) - MOST_STATES_SHOWN
    return shown + (f" ... and {more} more" if more > 0 else "")


def _state_times(history: StateHistory, outcome: ReplayResult) -> list[str]:
    """Return the states that begin at another time, of sequences that are the same."""
    if history.differs:
        return []
    lines = []
    for (recorded_ns, name), (replayed_ns, _) in zip(*history.sides, strict=True):
        if recorded_ns != replayed_ns:
            shift = shift_text(replayed_ns - recorded_ns, outcome.grid.period_ns)
            lines.append(f"{name} of {_when(outcome, recorded_ns)} begins {shift}")
    return lines[:MOST_STATES_SHOWN]


def plant_lines(outcome: ReplayResult) -> list[str]:
    """Return how the plant compared, and when the loop was closed."""
    plant = outcome.plant
    assert plant is not None
    lines = []
    if outcome.request.plant:
        share = f"{plant.differing} of {plant.compared}"
        lines.append(f"plant alone on the recorded commands: {share} frames differ")
        if plant.unmatched:
            lines.append(
                f"{counted(plant.unmatched, 'recorded frame')} of the plant without a counterpart"
            )
        lines += [f"{name}: at most {x:.6g} apart" for name, x in sorted(plant.largest.items())]
        if plant.first is not None:
            when, (name, a, b) = _when(outcome, plant.first.time_ns), plant.first.signals[0]
            lines.append(f"first at {when}: {name} recorded {a}, replayed {b}")
        lines.append(attribution(outcome))
    if outcome.request.closed_loop and plant.closed_ns is None:
        lines.append("no command differs, so the loop stayed open")
    elif plant.closed_ns is not None:
        when = _when(outcome, plant.closed_ns)
        lines.append(f"loop closed at {when}: from there the plant answers")
    return lines


def _signal_lines(outcome: ReplayResult) -> list[str]:
    lines = []
    for name, entry in sorted(outcome.comparison.signals.items()):
        if entry.differing:
            size = "" if entry.largest is None else f", at most {entry.largest:.6g} apart"
            share, when = f"{entry.differing} of {entry.compared}", _when(outcome, entry.first_ns)
            lines.append(f"{name}: {share} differ{size}, first at {when}")
    equal = sum(1 for entry in outcome.comparison.signals.values() if not entry.differing)
    return [*lines, f"{counted(equal, 'signal')} without a difference"]


def _account_line(outcome: ReplayResult) -> str:
    account = outcome.account
    parts = [
        f"{account.inputs.total()} inputs",
        f"{account.answers.total()} answers of the control unit",
        f"{account.plant.total()} of the plant",
        f"{account.foreign} foreign",
    ]
    if account.unheard:
        parts.append(f"{account.unheard.total()} inputs while off the bus")
    if account.other:
        parts.append(f"{account.other.total()} others")
    return (
        f"{account.total} of {counted(outcome.frames, 'frame')} accounted for: {', '.join(parts)}"
    )


def account_lines(outcome: ReplayResult) -> list[str]:
    """Return how many frames of each message were read, by what they were used for."""
    account = outcome.account
    parts = (
        ("inputs", sorted(account.inputs.items())),
        ("inputs not heard", sorted(account.unheard.items())),
        ("answers", sorted(account.answers.items())),
        ("plant", sorted(account.plant.items())),
        ("others", sorted(account.other.items())),
        ("foreign", outcome.foreign),
    )
    return [
        f"{title}: {', '.join(f'{count} {name}' for name, count in counts)}"
        for title, counts in parts
        if counts
    ]


def _history(history: StateHistory, base_ns: int) -> dict[str, Any]:
    found: dict[str, Any] = {"name": history.name, "differs": history.differs}
    for side, changes in zip(("recorded", "replayed"), history.sides, strict=True):
        found[side] = [{"time_s": (ns + base_ns) / 1e9, "value": name} for ns, name in changes]
    return found


def _difference_dict(parting: Difference | None, base_ns: int) -> dict[str, Any] | None:
    if parting is None:
        return None
    return parting.as_dict(base_ns) | {"inputs": parting.inputs}
