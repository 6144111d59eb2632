"""A truck's J1939 log, packed by hand as SAE J1939-71 states: ETC1, ETC2 and EEC1 of a drive."""

from __future__ import annotations

import random

from can_dbc.frame import join_id
from sil.logs import LogFrame

MS = 1_000_000
START_NS = 1_700_000_000 * 10**9
RATIOS = {1: 11.7, 2: 9.2, 3: 7.1, 4: 5.6, 5: 4.4, 6: 3.5, 7: 2.7, 8: 2.1}
OUTPUT = 4000
"""Output shaft speed in 0.125 rpm: 500 rpm."""

NOT_AVAILABLE = 3
Drive = list[tuple[int, int, int, int]]
"""Shifts: begin and end in ms, from gear, to gear."""

SEVEN: Drive = [
    (2_000, 2_600, 0, 1),
    (5_000, 5_850, 1, 2),
    (8_000, 8_900, 2, 3),
    (11_010, 11_770, 3, 5),
    (15_000, 15_800, 5, 6),
    (19_000, 20_020, 6, 4),
    (24_000, 24_700, 4, 5),
]


def etc1(
    time_ms: float, flag: int, ratio: float | None = None, source: int = 3, channel: str = "can0"
) -> LogFrame:
    words = bytes(4 * (0xFF,))
    if ratio is not None:
        raw_in = min(round(OUTPUT * ratio), 0xFAFF)
        words = OUTPUT.to_bytes(2, "little") + raw_in.to_bytes(2, "little")
    data = bytes((0xCC | flag << 4,)) + words[:2] + b"\xff\xf0" + words[2:] + b"\xff"
    can_id = join_id(3, 61442, source)
    return LogFrame(START_NS + round(time_ms * MS), can_id, data, channel=channel)


def etc2(
    time_ms: float,
    current: int | None,
    selected: int | None,
    source: int = 3,
    channel: str = "can0",
) -> LogFrame:
    raw = [0xFF if gear is None else gear + 125 for gear in (selected, current)]
    data = bytes((raw[0], 0xFF, 0xFF, raw[1], 0xFF, 0xFF, 0xFF, 0xFF))
    can_id = join_id(6, 61445, source)
    return LogFrame(START_NS + round(time_ms * MS), can_id, data, channel=channel)


def gear_at(drive: Drive, time_ms: float, lag_ms: float = 0.0) -> tuple[int, int]:
    """Current and selected gear: neutral while shifting, the new one `lag_ms` after the end."""
    current = selected = drive[0][2]
    for begin, end, old, new in drive:
        if time_ms >= begin:
            selected = new
            current = 0 if time_ms < end + lag_ms else new
            if time_ms < begin + 150:
                current = old
    return current, selected


def truck(
    drive: Drive = SEVEN,
    *,
    flags: bool = True,
    gears: bool = True,
    speeds: bool = False,
    lag_ms: float = 60.0,
    period_ms: int = 10,
    end_ms: int = 28_000,
    source: int = 3,
    channel: str = "can0",
) -> list[LogFrame]:
    """A truck's log: ETC1 at 100 Hz, ETC2 at 10 Hz, and what else is on its bus."""
    rng = random.Random(7)
    found = []
    for time_ms in range(0, end_ms, period_ms):
        shifting = any(begin <= time_ms < end for begin, end, _, _ in drive)
        current, selected = gear_at(drive, time_ms, lag_ms)
        ratio = None
        if speeds:
            ratio = RATIOS.get(current) or rng.uniform(1.0, 15.0)
        flag = int(shifting) if flags else NOT_AVAILABLE
        found.append(etc1(time_ms + rng.uniform(0, 0.4), flag, ratio, source, channel))
        if gears and time_ms % 100 == 30:
            found.append(etc2(time_ms + 0.5, current, selected, source, channel))
        if time_ms % 20 == 0:
            engine = LogFrame(found[-1].time_ns + 1000, 0x0CF00400, rng.randbytes(8))
            found.append(engine._replace(channel=channel))
    return found


def eec1(time_ms: float, torque: int, rpm: float) -> LogFrame:
    data = bytes((0xF0, 125, torque + 125)) + round(8 * rpm).to_bytes(2, "little") + b"\xff" * 3
    return LogFrame(START_NS + round(time_ms * MS), 0x0CF00400, data, channel="can0")


def with_engine(end_ms: int = 12_000) -> list[LogFrame]:
    frames = [f for f in truck(SEVEN[:3], speeds=True, end_ms=end_ms) if f.can_id != 0x0CF00400]
    for time_ms in range(0, end_ms, 10):
        cut = any(begin - 60 <= time_ms < end for begin, end, _, _ in SEVEN)
        frames.append(eec1(time_ms + 0.2, -5 if cut else 60, 1200 if cut else 1500))
    return sorted(frames, key=lambda frame: frame.time_ns)
