"""Reading a truck's log: another layout gives the same shifts, senders are chosen, clocks may step."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.codec import can_id_of
from can_dbc.errors import InputError
from can_dbc.messages import ValveCommand
from sil.j1939.mapping import LAYOUT, SHIPPED, SignalMapping
from sil.log_replay.truck_log import TruckLog
from sil.log_replay.truck_shift import recorded_shift
from sil.logs import LogFrame
from tests.support.truck_synthesis import MS, START_NS, Truck, changed, replace, without

FRAMES = Truck().frames()

PROPRIETARY = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Gears: 8 X
 SG_ Wanted : 7|8@0+ (1,0) [0|0] "" X
 SG_ Engaged : 15|8@0+ (1,0) [0|0] "" X
 SG_ Busy : 16|1@1+ (1,0) [0|1] "" X
BO_ 257 Shafts: 8 X
 SG_ Out : 7|16@0+ (0.125,0) [0|0] "rpm" X
 SG_ In : 23|16@0+ (0.125,0) [0|0] "rpm" X
"""
ROWS = {
    "selected_gear": ("Gears", "Wanted", -125.0, 1.0),
    "current_gear": ("Gears", "Engaged", -125.0, 1.0),
    "shift_in_process": ("Gears", "Busy", 0.0, 1.0),
    "input_shaft_rad_s": ("Shafts", "In", 0.0, 0.10471975511965977),
    "output_shaft_rad_s": ("Shafts", "Out", 0.0, 0.10471975511965977),
}


def read(mapping: SignalMapping, frames: list[LogFrame]) -> TruckLog:
    log = TruckLog("truck.log", mapping)
    assert log.read(frames)
    return log


def proprietary(tmp_path: Path) -> SignalMapping:
    (tmp_path / "gearbox.dbc").write_text(PROPRIETARY)
    (tmp_path / "map.toml").write_text(
        "".join(
            f'[[signal]]\nmeaning = "{meaning}"\nmessage = "{message}"\nsignal = "{signal}"\n'
            f"offset = {offset}\nscale = {scale}\n"
            for meaning, (message, signal, offset, scale) in ROWS.items()
        )
    )
    return SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "gearbox.dbc"))


def as_proprietary(frames: list[LogFrame]) -> list[LogFrame]:
    """The same drive as 11-bit messages with the bytes in another order, both every 10 ms."""
    found, gears = [], b"\x7d\x7d"
    for frame in frames:
        data = frame.data
        if frame.can_id >> 8 & 0x3FFFF == 61445:
            gears = bytes((data[0], data[3]))
        elif frame.can_id >> 8 & 0x3FFFF == 61442:
            busy = bytes((data[0] >> 4 & 1,))
            shafts = data[2:0:-1] + data[6:4:-1] + bytes(4)
            plain = frame._replace(extended=False, can_id=0x100, data=gears + busy + bytes(5))
            found += [plain, plain._replace(can_id=0x101, data=shafts)]
    return found


def test_another_layout_gives_the_same_shifts(tmp_path: Path) -> None:
    standard = read(SignalMapping(), FRAMES)
    copied = SignalMapping(str(SHIPPED), str(LAYOUT))
    assert not copied.is_standard
    plain = [replace(shift, engine=None) for shift in standard.shifts]
    assert read(copied, FRAMES).shifts == plain
    other = read(proprietary(tmp_path), as_proprietary(FRAMES))
    assert len(other.shifts) == len(standard.shifts) == 3
    for ours, theirs in zip(other.shifts, standard.shifts, strict=True):
        assert (ours.start_ns, ours.end_ns) == (theirs.start_ns, theirs.end_ns)
        assert (ours.from_gear, ours.to_gear) == (theirs.from_gear, theirs.to_gear)
        a, b = recorded_shift(other, ours), recorded_shift(standard, theirs)
        assert a.times_s["synchronised"] == b.times_s["synchronised"]
        assert a.synchronisation is not None and b.synchronisation is not None
        assert a.synchronisation.step_rad_s == pytest.approx(b.synchronisation.step_rad_s)


def test_a_map_without_the_gears_is_refused(tmp_path: Path) -> None:
    proprietary(tmp_path)
    text = (tmp_path / "map.toml").read_text().split("[[signal]]")
    (tmp_path / "map.toml").write_text("[[signal]]".join(["", *text[4:]]))
    found = read(
        SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "gearbox.dbc")),
        as_proprietary(FRAMES),
    )
    with pytest.raises(
        InputError, match=r"no signal for current_gear and selected_gear in .*map\.toml"
    ):
        found.require_shifts()


def test_the_first_signal_with_values_counts_and_the_nearest_sender() -> None:
    """AIR1's supply pressure is not available: the brake circuit's; of two engines the lower address."""

    def circuit(data: bytearray) -> None:
        data[0], data[2] = 0xFF, 100

    other = [
        f._replace(can_id=f.can_id | 0x29)
        for f in changed(FRAMES, 61444, lambda data: data.__setitem__(2, 125))
        if f.can_id >> 8 & 0x3FFFF == 61444
    ]
    frames = sorted([*changed(FRAMES, 65198, circuit), *other])
    log = read(SignalMapping(), frames)
    shift = log.shifts[0]
    span = shift.start_ns - 1500 * MS, shift.end_ns + 1500 * MS
    pressure = log.samples("supply_pressure_pa", shift, *span, shift.start_ns)
    assert pressure is not None and set(pressure.values) == {901325.0}
    assert pressure.origin == "AIR1.ServiceBrakeCircuit1AirPress of 0x30"
    torque = log.samples("engine_torque_share", shift, *span, shift.start_ns)
    assert torque is not None and torque.origin.endswith("of 0x00")
    assert max(torque.values) == pytest.approx(0.6)
    speeds = log.samples("engine_rad_s", replace(shift, channel="other"), *span, shift.start_ns)
    assert speeds is not None  # on the only channel there is


def test_reading_ends_at_a_command_of_our_unit() -> None:
    own = LogFrame(START_NS + 5_000 * MS, can_id_of(ValveCommand), bytes(8))
    frames = sorted([*FRAMES, own])
    log = TruckLog("own.log", SignalMapping())
    assert not log.read(frames, own.can_id)
    assert log.frames < len(frames) and log.shifts == []
    assert len(read(SignalMapping(), frames).shifts) == 3


def test_a_clock_that_steps_back_and_short_frames_are_no_trap() -> None:
    back = [
        f._replace(time_ns=f.time_ns - 4_000 * MS)
        for f in FRAMES
        if f.time_ns > START_NS + 11_000 * MS
    ]
    frames = without(FRAMES, 11_000, 99_000) + back
    log = read(SignalMapping(), frames)
    for shift in log.shifts:
        assert recorded_shift(log, shift).times_s.keys()
    short = [f._replace(data=f.data[:4]) if f.time_ns % (100 * MS) == 0 else f for f in FRAMES]
    log = read(SignalMapping(), short)
    assert [s.to_gear for s in log.shifts] == [4, 5, 4]
    assert any("fewer than 8 bytes" in note for note in log.notes)


def test_remote_and_error_frames_show_nothing(tmp_path: Path) -> None:
    for mapping, frames in (
        (SignalMapping(), FRAMES),
        (proprietary(tmp_path), as_proprietary(FRAMES)),
    ):
        odd = [f._replace(error=True) for f in frames]
        odd += [f._replace(remote=True, data=b"") for f in frames]
        log = read(mapping, odd)
        assert log.shifts == [] and log.frames == 2 * len(frames)
        with pytest.raises(InputError, match=r"no ETC1|no Shafts"):
            log.require_shifts()
