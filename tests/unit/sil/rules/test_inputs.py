"""Rules about what the firmware concludes from its inputs: kept by healthy runs, broken by one wrong report."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from can_dbc.codec import can_id_of
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    Fault,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from sil.recording.run_record import RunRecord
from tests.unit.sil.rules.test_rules import broken, healthy, sent_otherwise


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
    record = healthy().record
    assert "blind_gear" in broken(without(PositionPulse, 1.0, record))
    (confirmed_s,) = (shift.confirmed_s for shift in healthy().shifts)
    assert confirmed_s is not None and confirmed_s < 1.0
    unknown = changed(1.07, confirmed=Gear.UNKNOWN, faults=Fault.POSITION_LOST)
    assert "blind_gear" not in broken(without(PositionPulse, 1.0, unknown))


def test_a_push_without_a_request() -> None:
    assert broken(without(ShiftRequest, 0.0, healthy().record)) == [
        "unrequested_push",
        "missed_loss",
    ]
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
    reported = without(kind, 1.0, changed(1.05, faults=fault))
    assert "missed_loss" not in broken(reported)
    assert "missed_loss" in broken(without(kind, 0.0, healthy().record))  # none at all


@pytest.mark.parametrize("fault", [Fault.POSITION_LOST, Fault.REQUEST_LOST])
def test_a_loss_that_is_none(fault: Fault) -> None:
    assert broken(changed(1.0, faults=fault)) == ["false_loss"]
    assert "false_loss" in broken(changed(-1.0, faults=fault))  # from the first step on
    assert "false_loss" not in broken(changed(1.0, faults=fault), disturbed=True)
