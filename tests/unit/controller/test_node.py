"""The controller as a participant: ticks, deliveries, releases, and bad frames."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import can_id_of, decode, encode
from can_dbc.e2e import E2eStatus, Protector
from can_dbc.frame import Frame
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    E2eState,
    Etc1,
    Etc2,
    Fault,
    Gear,
    PlantPressures,
    PositionPulse,
    SafetyBlow,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs, Outputs
from controller.node import ControllerNode
from controller.settings import E2eConfig
from tests.support.toy_actuator import MS, pulse_s

HEARD = (PositionPulse, ShiftRequest, DrivelineSpeeds)


class Bus:
    """Sends what a healthy plant and driver send, and advances the node from tick to tick."""

    def __init__(self, config: FirmwareConfig | None = None) -> None:
        self.node = ControllerNode(config or FirmwareConfig())
        self.now_ns = self.node.start()
        self.pulses = Protector(PositionPulse)
        self.requests = Protector(ShiftRequest)
        self.speeds = Protector(DrivelineSpeeds)
        self.count = 0
        self.sent: list[tuple[int, Frame]] = []

    def pulse(self, position_m: float = 0.0) -> Frame:
        self.count += 1
        return self.pulses.protect(PositionPulse(pulse_s(position_m), 293.15, self.count % 256))

    def all_frames(self, gear: Gear = Gear.NEUTRAL) -> list[Frame]:
        return [
            self.requests.protect(ShiftRequest(gear)),
            self.pulse(),
            self.speeds.protect(DrivelineSpeeds(10.0, 10.0)),
        ]

    def tick(self, *frames: Frame, at_ns: int | None = None) -> list[Frame]:
        """Deliver frames 1 ms before the tick (or at a time) and return what the tick releases."""
        arrival_ns = self.now_ns - MS if at_ns is None else at_ns
        arrival_ns = max(arrival_ns, 0)
        self.sent, following_ns = self.node.advance(
            self.now_ns, [(arrival_ns, frame) for frame in frames]
        )
        self.now_ns = following_ns
        return [frame for _, frame in self.sent]

    def status(self) -> ControllerStatus:
        assert self.node.outputs is not None
        return self.node.outputs.status

    def awake(self, gear: Gear = Gear.NEUTRAL) -> Bus:
        for _ in range(20):
            self.tick(*self.all_frames(gear))
        return self


def test_ticks_are_multiples_of_the_period() -> None:
    node = ControllerNode(FirmwareConfig(period_s=0.0025))
    assert node.name == "controller"
    assert node.start() == 0
    for k in range(10):
        _, following_ns = node.advance(k * 2_500_000, [])
        assert following_ns == (k + 1) * 2_500_000
    node.close()


def test_frames_of_a_step_and_their_release() -> None:
    bus = Bus(FirmwareConfig(computation_s=0.0002))
    bus.tick()
    frames = bus.tick()
    assert [time_ns for time_ns, _ in bus.sent] == [10 * MS + 200_000] * 5
    kinds = [type(decode(frame)) for frame in frames]
    assert kinds == [ValveCommand, SafetyBlow, ControllerStatus, Etc1, Etc2]
    out = bus.node.outputs
    wanted = [out.valves, out.blow, out.status, out.etc1, out.etc2]
    assert [decode(frame) for frame in frames] == wanted


def test_broadcasts_only_when_due() -> None:
    bus = Bus(FirmwareConfig(period_s=0.0025))
    assert [len(bus.tick()) for _ in range(9)] == [5, 3, 3, 3, 5, 3, 3, 3, 5]


def test_a_grant_between_ticks_takes_deliveries_and_does_not_step() -> None:
    bus = Bus()
    bus.tick()
    before = bus.node.outputs
    first, second = bus.all_frames(), bus.all_frames()
    assert bus.node.advance(4 * MS, [(3 * MS, f) for f in first]) == ([], 10 * MS)
    assert bus.node.outputs is before
    bus.node.advance(10 * MS, [(9 * MS, f) for f in second])
    assert bus.node.pulses.counts[E2eStatus.OK] == 1  # the first one only starts the sequence
    assert bus.status().estimate_m == pytest.approx(0.0, abs=1e-4)


def test_a_skipped_tick_is_refused() -> None:
    bus = Bus()
    bus.tick()
    with pytest.raises(ValueError, match=r"advance to 10000001 ns skips the tick at 10000000 ns"):
        bus.node.advance(10_000_001, [])


def test_a_unit_that_stalled_goes_on_with_the_tick_it_wakes_up_at() -> None:
    bus = Bus()
    bus.tick()
    bus.now_ns = 50 * MS
    assert bus.tick() and bus.now_ns == 60 * MS
    late = Bus()  # before its first tick it may wake up at any time
    assert late.node.advance(25 * MS, []) == ([], 30 * MS)


def test_a_frame_that_arrives_at_the_tick_is_seen_by_it() -> None:
    bus = Bus().awake()
    seen = bus.node.pulses.counts[E2eStatus.OK]
    bus.tick(*bus.all_frames(Gear.BACKWARD), at_ns=bus.now_ns)
    assert bus.node.pulses.counts[E2eStatus.OK] == seen + 1
    assert bus.status().state is ShiftState.PUSH


def test_awake_and_a_request_is_obeyed() -> None:
    bus = Bus().awake()
    assert bus.status().state is ShiftState.IDLE
    assert bus.status().confirmed is Gear.NEUTRAL
    assert bus.status().faults is Fault.NONE
    command = decode(bus.tick(*bus.all_frames(Gear.BACKWARD))[0])
    assert command.duty_b == pytest.approx(0.98, abs=4e-5)  # the resolution of the DBC
    assert (command.duty_n, command.duty_f) == (0.0, 0.0)
    assert command.target is Gear.BACKWARD


def test_speeds_reach_the_firmware() -> None:
    out = Bus().awake().node.outputs
    assert (out.etc1.input_shaft_rad_s, out.etc1.output_shaft_rad_s) == (10.0, 10.0)


class Recorder(Firmware):
    """The firmware, with a record of its inputs."""

    def __init__(self, config: FirmwareConfig) -> None:
        super().__init__(config)
        self.steps: list[Inputs] = []

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        self.steps.append(inputs)
        return super().step(now_ns, inputs)


def test_every_pulse_between_two_ticks_reaches_the_firmware_once() -> None:
    bus = Bus()
    bus.node.firmware = recorder = Recorder(FirmwareConfig())
    bus.awake()
    frames = [bus.pulse(x) for x in (0.0001, 0.0002, 0.0003)]
    bus.tick(*frames)
    assert bus.node.pulses.counts[E2eStatus.OK] == 19 + 3
    bus.tick()
    assert recorder.steps[-1].pulses == ()
    indices = [pulse.sample_index for step in recorder.steps for pulse in step.pulses]
    assert indices == list(range(2, 24))  # the first one only starts the sequence


def test_own_and_foreign_frames_are_ignored() -> None:
    bus = Bus().awake()
    foreign = [
        encode(PlantPressures(1e5, 1e5, 1e5, 9e5)),
        Frame(0x123, b""),
        Frame(0x1FFFFFFF, b"12345678"),
        *bus.tick(*bus.all_frames()),
    ]
    bus.tick(*foreign, *bus.all_frames())
    for receiver in (bus.node.pulses, bus.node.requests, bus.node.speeds):
        assert receiver.counts[E2eStatus.ERROR] == 0
        assert sum(receiver.counts.values()) == 22


def test_receivers_have_the_configured_timeouts() -> None:
    config = FirmwareConfig(
        e2e=E2eConfig(position_timeout_s=0.061, request_timeout_s=0.072, speeds_timeout_s=0.083)
    )
    node = ControllerNode(config)
    assert node.pulses.timeout_ns == 61 * MS and node.requests.timeout_ns == 72 * MS
    assert node.speeds.timeout_ns == 83 * MS


@pytest.mark.parametrize(
    ("silent", "fault", "after_ms"),
    [(0, Fault.REQUEST_LOST, 100), (1, Fault.POSITION_LOST, 50), (2, Fault.SPEEDS_LOST, 50)],
)
def test_a_channel_that_falls_silent_is_lost_after_its_timeout(
    silent: int, fault: Fault, after_ms: int
) -> None:
    bus = Bus().awake()
    last_ns = bus.now_ns - 10 * MS - MS  # arrival of the last frames
    while bus.status().faults is Fault.NONE:
        frames = bus.all_frames()
        del frames[silent]
        bus.tick(*frames)
    assert bus.status().faults == fault
    told_ns = bus.now_ns - 10 * MS
    assert last_ns + after_ms * MS < told_ns <= last_ns + (after_ms + 10) * MS


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_corrupted_channel_is_not_believed_and_recovers(which: int) -> None:
    bus = Bus().awake()
    receiver = [bus.node.requests, bus.node.pulses, bus.node.speeds][which]
    fault = [Fault.REQUEST_LOST, Fault.POSITION_LOST, Fault.SPEEDS_LOST][which]
    for _ in range(3):
        frames = bus.all_frames(Gear.BACKWARD if which == 0 else Gear.NEUTRAL)
        good = frames[which]
        frames[which] = Frame(good.can_id, bytes([good.data[0] ^ 0x10]) + good.data[1:])
        bus.tick(*frames)
        assert bus.status().state is not ShiftState.PUSH
    assert receiver.counts[E2eStatus.ERROR] == 3
    assert receiver.state(bus.now_ns - 10 * MS) is E2eState.INVALID
    assert bus.status().faults == fault
    for _ in range(20):
        bus.tick(*bus.all_frames())
    assert bus.status().faults is Fault.NONE


@given(
    st.lists(
        st.tuples(
            st.sampled_from([can_id_of(kind) for kind in HEARD]) | st.integers(0, 0x1FFFFFFF),
            st.binary(max_size=8),
        ),
        max_size=40,
    )
)
@settings(max_examples=200, deadline=None)
def test_arbitrary_frames_never_raise_and_never_open_a_valve(
    frames: list[tuple[int, bytes]],
) -> None:
    bus = Bus()
    for _ in range(3):
        for frame in bus.tick(*(Frame(*f) for f in frames))[:2]:
            message = decode(frame)
            if isinstance(message, ValveCommand):
                assert (message.duty_b, message.duty_n, message.duty_f) == (0.0, 0.0, 0.0)
            else:
                assert not message.active


@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 255)), min_size=1, max_size=3))
@settings(max_examples=200, deadline=None)
def test_a_request_with_any_changed_byte_moves_nothing(changes: list[tuple[int, int]]) -> None:
    bus = Bus().awake()
    frames = bus.all_frames(Gear.BACKWARD)
    data = bytearray(frames[0].data)
    for place, value in changes:
        data[place] = value
    changed = bytes(data) != frames[0].data
    frames[0] = Frame(frames[0].can_id, bytes(data))
    bus.tick(*frames)
    assert (bus.status().state is ShiftState.PUSH) == (not changed)


def test_another_program_takes_the_place_of_the_firmware() -> None:
    program = Firmware(FirmwareConfig())
    assert ControllerNode(FirmwareConfig(), program).firmware is program
    assert isinstance(ControllerNode(FirmwareConfig()).firmware, Firmware)
