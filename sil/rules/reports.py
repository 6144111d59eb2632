"""What a receiver of the controller's status frames may believe, and when."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.codec import can_id_of
from can_dbc.e2e import ACCEPTED, Receiver
from can_dbc.instants import NS_PER_S
from can_dbc.messages import ControllerStatus, E2eState, Gear
from controller.settings import WindowConfig
from sil.coupling.bus import BusFrame
from sil.recording.run_record import RunRecord

REPORT_HOLDS_S = 0.05  # a status frame is valid for this long


def sent(record: RunRecord, kind: Any) -> Iterator[tuple[float, Any]]:
    """Yield the controller's messages that pass end-to-end protection, with the time in s of sending."""
    for entry, message in accepted(record, kind):
        if message is not None and entry.sender == "controller":
            yield entry.released_ns / NS_PER_S, message


def accepted(record: RunRecord, kind: Any) -> list[tuple[BusFrame, Any]]:
    """Return the frames that pass end-to-end protection; None as message where it turns invalid."""
    if kind in record.derived:
        return cast("list[tuple[BusFrame, Any]]", record.derived[kind])
    receiver = Receiver(kind, round(REPORT_HOLDS_S * NS_PER_S))
    messages: list[tuple[BusFrame, Any]] = []
    for entry in record.frames_of(can_id_of(kind)):
        status = receiver.receive(entry.arrival_ns, entry.frame)
        if receiver.state(entry.arrival_ns) is not E2eState.VALID:
            messages.append((entry, None))
        elif status in ACCEPTED:
            messages.append((entry, receiver.message))
    record.derived[kind] = messages
    return messages


def falsely_reported(record: RunRecord, windows: WindowConfig) -> NDArray[np.bool_]:
    """Return at which rows [n] of the trace a gear is reported that the stay is not in.

    A report counts until the next one arrives, at most REPORT_HOLDS_S; the limit is twice the window's
    width, because the sensor's tick, noise and temperature shift the firmware's window.
    """
    status = accepted(record, ControllerStatus)
    time_s, position_m = record.truth["time_s"], record.truth["position_m"]
    goals_m = {Gear.NEUTRAL: 0.0, Gear.BACKWARD: record.stroke_m, Gear.FORWARD: -record.stroke_m}
    wrong = np.zeros(len(time_s), dtype=np.bool_)
    for (entry, message), follower in zip_longest(status, status[1:]):
        if message is None or message.confirmed == Gear.UNKNOWN:
            continue
        begin = entry.arrival_ns / NS_PER_S
        end = np.inf if follower is None else follower[0].arrival_ns / NS_PER_S
        low, high = np.searchsorted(time_s, [begin, min(end, begin + REPORT_HOLDS_S)])
        neutral = message.confirmed == Gear.NEUTRAL
        width = windows.neutral_tolerance_m if neutral else windows.gear_tolerance_m
        away_m = np.abs(position_m[low:high] - goals_m[message.confirmed])
        wrong[low:high] = away_m > 2.0 * width
    return wrong
