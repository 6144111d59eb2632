"""Each rule: kept by a healthy run, broken by a record in which just that is wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from can_dbc.codec import can_id_of
from can_dbc.e2e import Protector
from can_dbc.errors import InputError
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    Fault,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from sil.coupling.bus import BusFrame
from sil.recording.run_record import RunRecord
from sil.rules import violations
from sil.rules.shipped import RULES
from sil.rules.user_file import load_rules
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import from_table
from tests.faults.drawn import base

SHORT = {"controller": {"shift": {"push_timeout_s": 0.3, "retries": 0}}, "duration_s": 2.0}


@cache
def healthy() -> Run:
    return run_in_memory(from_table(base("N-B") | SHORT, "test"))


def broken(record: RunRecord, **changes: Any) -> list[str]:
    given = dataclasses.replace(circumstances(healthy().scenario), **changes)
    return [violation.rule for violation in violations(record, given, RULES)]


def sent_otherwise(
    kind: type[Any], change: Callable[[float, Any], Any], record: RunRecord | None = None
) -> RunRecord:
    """The healthy record with each message of a kind replaced by what `change` makes of it at its time, s."""
    record, protector = record or healthy().record, Protector(kind)
    frames = [frame for frame in record.frames if frame.frame.can_id != can_id_of(kind)]
    for entry, message in record.of(kind):
        frame = protector.protect(change(entry.released_ns / 1e9, message))
        frames.append(BusFrame(entry.released_ns, entry.arrival_ns, entry.sender, frame))
    return dataclasses.replace(record, frames=sorted(frames, key=lambda f: f.arrival_ns))


def test_a_healthy_run_keeps_every_rule() -> None:
    run = healthy()
    assert run.shifts[0].confirmed_s is not None  # not vacuous: there was a shift
    assert broken(run.record) == []
    assert broken(sent_otherwise(ValveCommand, lambda _, command: command)) == []


def test_a_coil_that_outlives_the_controller() -> None:
    assert broken(healthy().record, down_s=((0.12, np.inf),)) == ["orphan_coil"]


def test_a_gear_that_the_stay_is_not_in() -> None:
    record = healthy().record
    still = dict(record.truth) | {"position_m": np.zeros_like(record.truth["position_m"])}
    assert broken(dataclasses.replace(record, truth=still)) == ["false_gear", "false_position"]


@pytest.mark.parametrize("at_s", [0.3, 0.16])
def test_both_gears_filled_together_or_soon_after_each_other(at_s: float) -> None:
    """Backward is filled from 0.11 s to some 0.3 s."""

    def filled(time_s: float, command: ValveCommand) -> ValveCommand:
        return dataclasses.replace(command, duty_f=0.98 if at_s < time_s < at_s + 0.02 else 0.0)

    assert broken(sent_otherwise(ValveCommand, filled)) == ["opposed_chambers"]


def test_a_coil_on_for_too_long() -> None:
    always_on = sent_otherwise(ValveCommand, lambda _, c: dataclasses.replace(c, duty_n=0.98))
    assert broken(always_on) == ["coil_on_time"]


def test_a_coil_that_is_off_for_a_step_begins_anew() -> None:
    """Off in one step of ten, 0.1 s apart: never on for longer than that."""

    def pulsed(time_s: float, command: ValveCommand) -> ValveCommand:
        return dataclasses.replace(command, duty_n=0.0 if round(100.0 * time_s) % 10 == 0 else 0.98)

    assert broken(sent_otherwise(ValveCommand, pulsed)) == []


def test_a_request_that_nobody_answers() -> None:
    def idle(_: float, status: ControllerStatus) -> ControllerStatus:
        return dataclasses.replace(status, confirmed=Gear.UNKNOWN, state=ShiftState.IDLE)

    expected = ["unconfirmed_gear", "unanswered_request"]
    assert broken(sent_otherwise(ControllerStatus, idle)) == expected
    assert broken(sent_otherwise(ControllerStatus, idle), disturbed=True) == []
    for unreliable in ({"true_samples": False}, {"forced": True}):
        record = sent_otherwise(ControllerStatus, idle)
        assert "unanswered_request" not in broken(record, **unreliable)


def test_a_push_that_is_given_up_too_early() -> None:
    def gives_up(time_s: float, status: ControllerStatus) -> ControllerStatus:
        failed = dataclasses.replace(status, state=ShiftState.FAULT, faults=Fault.SHIFT_TIMEOUT)
        return failed if time_s > 0.14 else status

    assert broken(sent_otherwise(ControllerStatus, gives_up)) == ["early_refusal"]


def test_a_push_that_is_tried_once_more() -> None:
    def pauses(time_s: float, status: ControllerStatus) -> ControllerStatus:
        vents = 0.12 < time_s < 0.13
        return dataclasses.replace(status, state=ShiftState.VENT) if vents else status

    assert broken(sent_otherwise(ControllerStatus, pauses)) == ["too_many_attempts"]


def test_a_search_that_ends_too_early() -> None:
    def loses(time_s: float, status: ControllerStatus) -> ControllerStatus:
        if not 0.5 < time_s < 0.6:
            return status
        state = ShiftState.INIT if time_s < 0.55 else ShiftState.IDLE
        return dataclasses.replace(status, confirmed=Gear.UNKNOWN, state=state)

    assert broken(sent_otherwise(ControllerStatus, loses)) == ["early_rest"]


@pytest.mark.parametrize(
    ("stage", "after"),
    [(ShiftState.BLOW, ShiftState.HOLD), (ShiftState.HOLD, ShiftState.VENT),
     (ShiftState.VENT, ShiftState.IDLE)],
)  # fmt: skip
def test_a_stage_that_is_cut_short(stage: ShiftState, after: ShiftState) -> None:
    begun: list[float] = []

    def cut(time_s: float, status: ControllerStatus) -> ControllerStatus:
        if status.state is stage:
            begun.append(time_s)
            if time_s > begun[0] + 0.005:
                return dataclasses.replace(status, state=after)
        return status

    assert broken(sent_otherwise(ControllerStatus, cut)) == ["cut_short"]


def test_a_fault_state_without_a_fault() -> None:
    def fails(time_s: float, status: ControllerStatus) -> ControllerStatus:
        failed = dataclasses.replace(status, state=ShiftState.FAULT, confirmed=Gear.UNKNOWN)
        return failed if time_s > 0.5 else status

    assert broken(sent_otherwise(ControllerStatus, fails)) == ["unnamed_fault"]


def test_a_fault_that_only_an_error_can_raise() -> None:
    failed = sent_otherwise(
        ControllerStatus, lambda t, s: dataclasses.replace(s, faults=Fault.INTERNAL)
    )
    assert broken(failed) == ["internal_fault"]


def test_frames_without_counter_or_within_no_range() -> None:
    record = healthy().record
    commands = [f for f in record.frames if f.frame.can_id == can_id_of(ValveCommand)]
    again = [f._replace(frame=commands[0].frame) if f in commands else f for f in record.frames]
    assert broken(dataclasses.replace(record, frames=again)) == ["sender_rules"]
    data = bytearray(commands[5].frame.data)
    data[2:] = b"\xff" * (len(data) - 2)
    odd = commands[5].frame._replace(data=bytes(data))
    wrong = [f._replace(frame=odd) if f is commands[5] else f for f in record.frames]
    assert broken(dataclasses.replace(record, frames=wrong)) == ["sender_rules", "outputs_in_range"]


def test_rules_of_a_users_file(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "from sil.rules import Rule\n"
        "RULES = [Rule('never_there', 'No stop.', 'me', lambda r, c: (0.5, 'it stopped'))]\n"
    )
    rules = load_rules(str(file))
    given = circumstances(healthy().scenario)
    assert [v.rule for v in violations(healthy().record, given, rules)] == ["never_there"]
    for text, place in (
        ("1/0", "own.py:1: ZeroDivisionError"),
        ("a =", "own.py:1: SyntaxError"),
        ("RULES = 3", "RULES: not a list"),
        (file.read_text().replace("never_there", "false_gear"), "'false_gear' is taken"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=place):
            load_rules(str(file))
    with pytest.raises(InputError, match="no such file"):
        load_rules(str(tmp_path / "none.py"))


def without(kind: type[Any], after_s: float, record: RunRecord) -> RunRecord:
    """The record without the frames of a kind from an instant on."""
    frames = [
        entry
        for entry in record.frames
        if entry.frame.can_id != can_id_of(kind) or entry.arrival_ns < 1e9 * after_s
    ]
    return dataclasses.replace(record, frames=frames)


def changed(after_s: float, **values: Any) -> RunRecord:
    """The healthy record with other values in the status frames from an instant on."""
    return sent_otherwise(
        ControllerStatus,
        lambda at_s, status: dataclasses.replace(status, **values) if at_s > after_s else status,
    )


def test_a_gear_confirmed_after_the_samples_have_ended() -> None:
    """The gear is confirmed from 0.16 s on; samples are valid for 50 ms after the last one."""
    assert "blind_gear" in broken(without(PositionPulse, 1.0, healthy().record))
    (confirmed_s,) = (shift.confirmed_s for shift in healthy().shifts)
    assert confirmed_s is not None and confirmed_s < 1.0
    unknown = changed(1.07, confirmed=Gear.UNKNOWN, faults=Fault.POSITION_LOST)
    assert "blind_gear" not in broken(without(PositionPulse, 1.0, unknown))


def test_a_push_without_a_request() -> None:
    never = without(ShiftRequest, 0.0, healthy().record)
    assert broken(never) == ["unrequested_push", "missed_loss"]
    latest = without(ShiftRequest, 0.105, healthy().record)  # still valid when the push begins
    assert broken(latest) == ["missed_loss"]


def test_a_gear_confirmed_before_its_samples() -> None:
    pushing_s = 0.13  # the stay is on its way
    early = changed(pushing_s, confirmed=Gear.BACKWARD, state=ShiftState.BLOW)
    assert "unsampled_gear" in broken(early)
    assert "unsampled_gear" not in broken(early, true_samples=False)


def test_a_position_that_the_stay_has_not_been_at() -> None:
    assert broken(changed(1.0, estimate_m=0.0)) == ["false_position"]
    assert broken(changed(1.0, estimate_m=0.0, faults=Fault.POSITION_LOST), disturbed=True) == []


def test_an_estimate_that_starts_afresh_knows_nothing_older() -> None:
    """The stay moves by its stroke from 0.13 s on while no samples come."""
    record = healthy().record
    gap = [
        entry
        for entry in record.frames
        if entry.frame.can_id != can_id_of(PositionPulse) or not 0.12e9 < entry.arrival_ns < 0.22e9
    ]
    record = dataclasses.replace(record, frames=gap)
    stale = sent_otherwise(
        ControllerStatus,
        lambda at_s, status: dataclasses.replace(
            status,
            state=ShiftState.FAULT if at_s > 0.17 else status.state,
            faults=Fault.POSITION_LOST if at_s > 0.17 else status.faults,
            confirmed=Gear.UNKNOWN,
            estimate_m=0.0 if at_s < 0.27 else status.estimate_m,
        ),
        record,
    )
    assert broken(stale) == ["false_position"]
    assert broken(stale, disturbed=True) == []


def test_a_gear_that_is_there_and_not_confirmed() -> None:
    assert broken(changed(1.5, confirmed=Gear.UNKNOWN)) == ["unconfirmed_gear"]
    assert broken(changed(1.5, confirmed=Gear.UNKNOWN), disturbed=True) == []
    assert broken(changed(1.5, confirmed=Gear.UNKNOWN, state=ShiftState.VENT)) == []


@pytest.mark.parametrize(
    ("kind", "fault"),
    [(PositionPulse, Fault.POSITION_LOST), (ShiftRequest, Fault.REQUEST_LOST),
     (DrivelineSpeeds, Fault.SPEEDS_LOST)],
)  # fmt: skip
def test_a_loss_that_is_not_reported(kind: type[Any], fault: Fault) -> None:
    assert "missed_loss" in broken(without(kind, 1.0, healthy().record))
    assert "missed_loss" not in broken(without(kind, 1.0, changed(1.05, faults=fault)))
    assert "missed_loss" in broken(without(kind, 0.0, healthy().record))  # none at all


@pytest.mark.parametrize("fault", [Fault.POSITION_LOST, Fault.REQUEST_LOST])
def test_a_loss_that_is_none(fault: Fault) -> None:
    assert broken(changed(1.0, faults=fault)) == ["false_loss"]
    assert "false_loss" in broken(changed(-1.0, faults=fault))  # from the first step on
    assert "false_loss" not in broken(changed(1.0, faults=fault), disturbed=True)


FILE = """\
import os, sys
from sil.rules import Rule
{load}
def own(record, circumstances):
    {run}

RULES = [Rule("own", "A sentence.", "us", own)]
"""


def rules(folder: Path, load: str = "", run: str = "return None"):
    """Return the rules of a file with these statements."""
    path = folder / "own.py"
    path.write_text(FILE.format(load=load, run=run))
    return load_rules(str(path))


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("sys.exit(0)", "SystemExit: 0"),
        ("os._exit(0)", r"ProcessExit: os._exit\(0\)"),
        ("def f(): f()\nf()", "RecursionError: maximum recursion depth exceeded"),
    ],
)
def test_a_file_that_cannot_be_loaded(tmp_path: Path, statement: str, error: str) -> None:
    with pytest.raises(InputError, match=rf"own\.py:3: {error}.*; expected a list RULES of rules$"):
        rules(tmp_path, load=statement)


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("sys.exit(0)", "SystemExit: 0"),
        ("os._exit(0)", r"ProcessExit: os._exit\(0\)"),
        ("own(record, circumstances)", "RecursionError"),
        ("return 'broken'", "ValueError"),
    ],
)
def test_a_rule_that_fails_on_a_run(tmp_path: Path, statement: str, error: str) -> None:
    *shipped, own = rules(tmp_path, run=statement)
    assert tuple(shipped) == RULES
    with pytest.raises(InputError, match=rf"own\.py:\d: {error}.*, of rule 'own'$"):
        own.first(None, None)  # type: ignore[arg-type]


def test_what_a_rule_returns_is_kept(tmp_path: Path) -> None:
    assert rules(tmp_path)[-1].first(None, None) is None  # type: ignore[arg-type]
    broken = rules(tmp_path, run="return 1, 'hard'")[-1].first(None, None)  # type: ignore[arg-type]
    assert broken == (1.0, "hard")
