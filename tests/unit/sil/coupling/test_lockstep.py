"""The coordinator alone, with participants in one process: order, instants, refusals."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame, BusModel
from sil.coupling.clock import NEVER_NS
from sil.coupling.lockstep import Lockstep
from sil.coupling.real_time import Pacer
from sil.coupling.transports.channel import InProcess, ParticipantLost

US = 1000
Said = list[tuple[int, Frame]]
Heard = list[tuple[str, int, Said]]


class Node:
    """Follows a script: at each event the frames to send and the next event."""

    def __init__(
        self, name: str, heard: Heard, say: Callable[[int], tuple[Said, int]], first_ns: int = 0
    ) -> None:
        self.name = name
        self._heard = heard
        self._say = say
        self._first_ns = first_ns
        self.closed = 0

    def start(self) -> int:
        return self._first_ns

    def advance(self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]) -> tuple[Said, int]:
        self._heard.append((self.name, until_ns, list(deliveries)))
        return self._say(until_ns)

    def close(self) -> None:
        self.closed += 1


def every(period_ns: int, *frames: Frame) -> Callable[[int], tuple[Said, int]]:
    return lambda now: ([(now, frame) for frame in frames], now + period_ns)


def frame(can_id: int) -> Frame:
    return Frame(can_id, b"")


def bits(can_id: int) -> int:
    from sil.coupling.frame_bits import frame_bits

    return frame_bits(can_id, b"")


def lockstep(end_ns: int, *nodes: Node, pacer: Pacer | None = None) -> tuple[Lockstep, list]:
    recorded: list[BusFrame] = []
    return (
        Lockstep(
            BusModel(1_000_000), [InProcess(nodes)], end_ns, record=recorded.extend, pacer=pacer
        ),
        recorded,
    )


def test_equal_instants_have_a_defined_order_whatever_the_order_of_the_participants() -> None:
    heard: Heard = []
    names = ["plant", "driver", "controller"]
    nodes = [Node(name, heard, every(1000 * US, frame(0x100))) for name in names]
    coordinator, recorded = lockstep(2500 * US, *nodes)
    with coordinator:
        coordinator.run()
    assert [(name, now) for name, now, _ in heard] == [
        (name, now)
        for now in (0, 1000 * US, 2000 * US, 2500 * US)
        for name in ("driver", "controller", "plant")
    ]
    assert [d.sender for d in recorded[:3]] == ["driver", "controller", "plant"]
    assert [node.closed for node in nodes] == [1, 1, 1]


def test_a_frame_that_arrives_at_an_instant_is_delivered_at_it_and_one_after_is_not() -> None:
    length_ns = bits(0x200) * US
    for event_ns, expected in ((length_ns, [(length_ns, frame(0x200))]), (length_ns - 1, [])):
        heard: Heard = []
        sender = Node("driver", heard, lambda now: ([(now, frame(0x200))], NEVER_NS))
        receiver = Node("plant", heard, lambda now: ([], NEVER_NS), first_ns=event_ns)
        coordinator, _ = lockstep(10_000 * US, sender, receiver)
        with coordinator:
            coordinator.run()
        assert heard[1] == ("plant", event_ns, expected)


def test_everyone_but_the_sender_receives_all_frames_in_order() -> None:
    heard: Heard = []
    nodes = [
        Node("driver", heard, every(1000 * US, frame(0x300), frame(0x100))),
        Node("controller", heard, every(1000 * US, frame(0x200))),
        Node("plant", heard, every(500 * US)),
    ]
    coordinator, recorded = lockstep(5000 * US, *nodes)
    with coordinator:
        summary = coordinator.run()
    for name in ("driver", "controller", "plant"):
        all_heard = [d for who, _, deliveries in heard if who == name for d in deliveries]
        assert all_heard == [(d.arrival_ns, d.frame) for d in recorded if d.sender != name]
        for who, now, deliveries in heard:
            if who == name and deliveries:
                assert deliveries[-1][0] <= now
    assert summary.frames == len(recorded) == 15
    assert summary.turns == len(heard)


def test_time_in_pieces_is_the_same_time() -> None:
    runs = []
    for pieces in ([], [0], [1, 2, 999 * US], [500 * US, 500 * US, 1700 * US]):
        heard: Heard = []
        nodes = [Node(n, heard, every(300 * US, frame(0x100))) for n in ("driver", "plant")]
        coordinator, recorded = lockstep(2000 * US, *nodes)
        with coordinator:
            for piece in pieces:
                coordinator.advance(piece)
                assert coordinator.now_ns <= piece
            coordinator.run()
        runs.append((heard, recorded))
    assert all(run == runs[0] for run in runs)


def test_a_run_of_sleepers_reaches_its_end() -> None:
    heard: Heard = []
    coordinator, _ = lockstep(10**12, Node("driver", heard, lambda now: ([], NEVER_NS)))
    with coordinator:
        coordinator.run()
    assert [now for _, now, _ in heard] == [0, 10**12]


@pytest.mark.parametrize(
    ("say", "complaint"),
    [
        (lambda now: ([(now - 1, frame(1))], now + 1), "not released before the grant"),
        (lambda now: ([(now, frame(1 << 25))], now + 1), "EDP clear"),
        (lambda now: ([(now, Frame(1, bytes(9)))], now + 1), "classic 29-bit frame"),
        (lambda now: ([], now), "expected a later one"),
        (lambda now: ([], now - 5), "expected a later one"),
    ],
)
def test_a_participant_against_the_rules_ends_the_run(
    say: Callable[[int], tuple[Said, int]], complaint: str
) -> None:
    node = Node("controller", [], say, first_ns=2000 * US)
    coordinator, _ = lockstep(10_000 * US, node)
    with (
        coordinator,
        pytest.raises(
            ParticipantLost, match=rf"^controller .*{complaint}.* \(at 0.002000 s simulated\)$"
        ) as lost,
    ):
        coordinator.run()
    assert lost.value.participant == "controller"
    assert node.closed == 1


def test_a_participant_that_raises_ends_the_run_by_name_and_keeps_its_error() -> None:
    def fail(now: int) -> tuple[Said, int]:
        raise ZeroDivisionError("no gear at all")

    coordinator, _ = lockstep(10_000 * US, Node("plant", [], fail, first_ns=1000 * US))
    with (
        coordinator,
        pytest.raises(
            ParticipantLost,
            match=r"^plant failed: ZeroDivisionError: no gear at all \(at 0.001000 s simulated\)$",
        ) as lost,
    ):
        coordinator.run()
    assert isinstance(lost.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("error", [InputError("a file"), RunError("a disk"), KeyboardInterrupt()])
def test_errors_for_the_user_pass_unchanged(error: BaseException) -> None:
    def fail(now: int) -> tuple[Said, int]:
        raise error

    node = Node("plant", [], fail)
    coordinator, _ = lockstep(10_000 * US, node)
    with coordinator, pytest.raises(type(error)) as raised:
        coordinator.run()
    assert raised.value is error and node.closed == 1


def test_a_first_event_before_the_start_is_refused() -> None:
    coordinator, _ = lockstep(1, Node("plant", [], every(1), first_ns=-1))
    with coordinator, pytest.raises(ParticipantLost, match="named -1 ns as its next event"):
        coordinator.run()


def test_real_time_follows_the_wall_clock() -> None:
    def say(now: int) -> tuple[Said, int]:
        return [(now, frame(0x100))], now + 10_000 * US

    coordinator, recorded = lockstep(100_000 * US, Node("driver", [], say), pacer=Pacer(1.0))
    with coordinator:
        started = time.monotonic()
        summary = coordinator.run()
        took = time.monotonic() - started
    assert took >= 0.1
    assert summary.lateness is not None
    assert summary.lateness.instants == 20  # 10 ticks after the first, 10 frames; none twice
    assert len(recorded) == 10
