"""One participant's session against a scripted coordinator: what it answers, what it refuses."""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError, RunError
from can_dbc.frame import SOCKETCAN_FRAME, Frame
from can_dbc.messages import StopReason
from sil.coupling.transports import wire
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.link import LocalLink, Session, open_link, take_part
from sil.coupling.transports.wire import Control, Kind, Refusal

CONTROLLER, PLANT = wire.PARTICIPANTS["controller"], wire.PARTICIPANTS["plant"]
PULSE = Frame(0x0CFF2591, b"\x01\x02\x03")
VALVES = Frame(0x08FF2003, b"\xff" * 8)


class ScriptedLink:
    """Plays records to a session and keeps what it wrote."""

    hello_again_s = 0.001

    def __init__(self, *script: bytes) -> None:
        self.script = deque(script)
        self.written: list[tuple[int, bytes]] = []
        self.welcomes = 0

    def read(self, timeout_s: float | None) -> list[tuple[int, bytes]]:
        if not self.script:
            if timeout_s is None:
                raise RunError("the script is over")
            return []
        return list(wire.split(self.script.popleft()))

    def write(self, records: Sequence[bytes]) -> None:
        self.written += [found for record in records for found in wire.split(record)]

    def welcomed(self, number: int) -> None:
        self.welcomes += 1

    def said(self) -> list[Control | None]:
        return [wire.parse_control(*found) for found in self.written]


def session(*script: bytes) -> tuple[Session, ScriptedLink]:
    link = ScriptedLink(*script)
    return Session("controller", link, scenario=0xABCD), link


def grant(frames: int, now_ns: int, number: int = CONTROLLER) -> bytes:
    return wire.control(Kind.GRANT, number, frames, now_ns)


def answer_hello(link: ScriptedLink, kind: Kind, extra: int, *before: bytes) -> None:
    """Answer to a hello with its own nonce, after other records."""
    answers = iter(before)

    def read(timeout_s: float | None) -> list[tuple[int, bytes]]:
        hello = link.said()[-1]
        assert hello is not None
        record = wire.control(kind, CONTROLLER, extra, hello.value & 0xFFFF)
        return list(wire.split(next(answers, record)))

    link.read = read  # type: ignore[method-assign]


def test_hello_is_repeated_until_welcomed_and_names_version_and_scenario() -> None:
    joining, link = session()
    others = wire.control(Kind.WELCOME, PLANT, wire.VERSION, 1)
    answer_hello(link, Kind.WELCOME, wire.VERSION, b"", b"", others)
    joining.join(0, 5.0)
    hellos = link.said()
    assert len(hellos) >= 1 and link.welcomes == 1
    assert set(hellos) == {hellos[0]}
    hello = hellos[0]
    assert hello is not None
    assert (hello.kind, hello.participant, hello.extra) == (Kind.HELLO, CONTROLLER, wire.VERSION)
    assert hello.value >> 16 == 0xABCD


@pytest.mark.parametrize("refusal", list(Refusal))
def test_a_refusal_is_reported(refusal: Refusal) -> None:
    joining, link = session()
    answer_hello(link, Kind.REFUSED, refusal)
    with pytest.raises(InputError, match=wire.reason(refusal)):
        joining.join(0, 5.0)


def test_an_unanswered_hello_is_reported_after_the_timeout() -> None:
    joining, link = session()
    with pytest.raises(RunError, match=r"no run answered within 0.2 s"):
        joining.join(0, 0.2)
    assert len(link.written) > 1


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(InputError, match="expected plant, controller, driver"):
        Session("gearbox", ScriptedLink())


def test_one_turn() -> None:
    joined, link = session(
        wire.control(Kind.START, value=10**9)
        + wire.announced(PLANT, 5_000, PULSE)
        + wire.announced(CONTROLLER, 6_000, VALVES)
        + grant(1, 10_000)
    )
    assert joined.next_grant() == (10_000, [(5_000, PULSE)])
    assert link.said() == [Control(Kind.DONE, CONTROLLER, 0, 0)]
    link.written.clear()
    joined.answer([(10_000, VALVES), (10_500, PULSE), (10_500, VALVES), (10_000, PULSE)], 20_000)
    assert link.said() == [
        None,
        Control(Kind.RELEASE, CONTROLLER, 255, 10_500),
        None,
        None,
        Control(Kind.RELEASE, CONTROLLER, 255, 10_000),
        None,
        Control(Kind.DONE, CONTROLLER, 4, 20_000),
    ]
    assert link.written[0] == (VALVES.can_id | 1 << 25, VALVES.data)
    link.script.append(wire.control(Kind.STOP, StopReason.END, value=1))
    assert joined.next_grant() is None
    assert joined.ending is StopReason.END


def test_what_is_meant_for_others_is_passed_over() -> None:
    joined, link = session(
        grant(7, 1, PLANT),
        wire.control(Kind.SYNC, PLANT),
        wire.control(Kind.SKIP, PLANT),
        wire.control(Kind.RETIRE, PLANT),
        wire.offer(PULSE),
        wire.control(Kind.WELCOME, CONTROLLER, 1, 1),
        SOCKETCAN_FRAME.pack(0x9FFF_FFFF, 3, b"abc"),
        grant(0, 5),
    )
    assert joined.next_grant() == (5, [])
    assert link.written == []


def test_sync_is_acknowledged_at_once() -> None:
    joined, link = session(wire.control(Kind.SYNC, CONTROLLER), grant(0, 5))
    assert joined.next_grant() == (5, [])
    assert [said and said.kind for said in link.said()] == [Kind.ACK]


def test_skipped_frames_are_not_received_and_not_counted() -> None:
    joined, _ = session(
        wire.control(Kind.SKIP, CONTROLLER)
        + wire.announced(PLANT, 1, PULSE)
        + wire.announced(PLANT, 2, PULSE)
        + grant(1, 3)
    )
    assert joined.next_grant() == (3, [(2, PULSE)])


@pytest.mark.parametrize("place", [0, 1, 2, 3, 4])
def test_foreign_frames_between_any_two_records_change_nothing(place: int) -> None:
    stranger = wire.real(Frame(0x18FEF100, b"\x11" * 8))
    time_1, frame_1 = wire.announced(PLANT, 1, PULSE)[:16], wire.real(PULSE)
    time_2, frame_2 = wire.announced(PLANT, 2, VALVES)[:16], wire.real(VALVES)
    records = [time_1, frame_1, time_2, frame_2, grant(2, 3)]
    records.insert(place, stranger)
    joined, _ = session(*records)
    assert joined.next_grant() == (3, [(1, PULSE), (2, VALVES)])


@given(st.integers(0, 4), st.integers(1, 300))
def test_a_lost_record_is_noticed(lost: int, count: int) -> None:
    """Losing any announcement or frame shows at the next announcement or grant."""
    records = []
    for number in range(count):
        announced = wire.announced(PLANT, number, Frame(0x0CFF2591, number.to_bytes(8, "big")))
        records += [announced[:16], announced[16:]]
    del records[(len(records) - 1) * lost // 4]
    joined, _ = session(*records, grant(count, 10**6))
    with pytest.raises(RunError, match="frames were lost"):
        joined.next_grant()


@pytest.mark.parametrize(
    ("instant_ns", "frame"),
    [
        (9_999, VALVES),
        (10_000, Frame(VALVES.can_id | 1 << 25, b"")),
        (10_000, Frame(VALVES.can_id | 1 << 24, b"")),
        (10_000, Frame(1 << 29, b"")),
        (10_000, Frame(1, bytes(9))),
    ],
)
def test_what_cannot_be_sent_is_an_error_of_the_node(instant_ns: int, frame: Frame) -> None:
    joined, link = session(grant(0, 10_000))
    joined.next_grant()
    with pytest.raises(ValueError, match="controller at 10000 ns"):
        joined.answer([(instant_ns, frame)], 20_000)
    assert link.written == []
    joined.fail()
    assert [said and said.kind for said in link.said()] == [Kind.FAILED]


@pytest.mark.parametrize("code", [StopReason.ABORTED, 2, 255])
def test_every_other_stop_is_an_early_one(code: int) -> None:
    joined, _ = session(wire.control(Kind.STOP, code, value=1))
    assert joined.next_grant() is None
    assert joined.ending is StopReason.ABORTED


# --- a participant's main loop ------------------------------------------------------------------


pytestmark = pytest.mark.usefixtures("runtime_folder")


class Counter:
    """Speaks every millisecond; fails at `fails_at`."""

    name = "controller"

    def __init__(self, fails_at: int = 1 << 60) -> None:
        self.instants: list[int] = []
        self.closed = 0
        self._fails_at = fails_at

    def start(self) -> int:
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        self.instants.append(until_ns)
        if until_ns >= self._fails_at:
            raise ZeroDivisionError
        return [], until_ns + 1_000_000

    def close(self) -> None:
        self.closed += 1


class Running:
    """`take_part` in a thread, its outcome kept."""

    def __init__(self, participant: Counter, channel: str) -> None:
        self.error: BaseException | None = None
        self._participant = participant
        self._channel = channel
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            take_part(self._participant, open_link(self._channel, 5.0), start_timeout_s=5.0)
        except Exception as error:
            self.error = error

    def outcome(self) -> BaseException | None:
        self._thread.join(10.0)
        assert not self._thread.is_alive()
        return self.error


def test_a_participant_takes_part_from_hello_to_stop() -> None:
    counter = Counter()
    running = Running(counter, "local:run")
    hub = Hub("run", ["controller"])
    assert hub.start(10**9) == {"controller": 0}
    for now_ns in range(0, 5_000_000, 1_000_000):
        hub.begin_turn(now_ns, ["controller"])
        assert hub.end_turn()["controller"] == ([], now_ns + 1_000_000)
    hub.close(aborted=False)
    assert running.outcome() is None
    assert counter.instants == list(range(0, 5_000_000, 1_000_000))
    assert counter.closed == 1


def test_a_participant_that_fails_says_so_and_raises_its_own_error() -> None:
    counter = Counter(fails_at=1_000_000)
    running = Running(counter, "local:run")
    hub = Hub("run", ["controller"])
    hub.start(10**9)
    hub.begin_turn(0, ["controller"])
    hub.end_turn()
    hub.begin_turn(1_000_000, ["controller"])
    with pytest.raises(RunError, match="controller failed; its own error output says why"):
        hub.end_turn()
    hub.close(aborted=True)
    assert isinstance(running.outcome(), ZeroDivisionError)
    assert counter.closed == 1


def test_an_early_end_and_a_lost_coordinator_are_errors_of_the_run() -> None:
    for aborted, message in ((True, "ended the run early"), (False, "the coordinator is gone")):
        counter = Counter()
        running = Running(counter, "local:run")
        hub = Hub("run", ["controller"])
        hub.start(10**9)
        if aborted:
            hub.close(aborted=True)
        else:  # as if the coordinator had been killed: no farewell
            for connection in hub._connections.values():
                connection.socket.shutdown(socket.SHUT_RDWR)
        error = running.outcome()
        assert isinstance(error, RunError) and message in str(error)
        assert counter.closed == 1
        hub.close(aborted=True)


def test_channels_are_local_names_or_can_interfaces() -> None:
    for nameless in ("local:", "local"):
        with pytest.raises(InputError, match="expected a name of letters"):
            open_link(nameless)
    with pytest.raises(RunError, match=r"no run on local:nobody within 0.05 s"):
        open_link("local:nobody", 0.05)
    with pytest.raises(InputError, match=r"channel 'nocan7': .*expected .*local:NAME, or the name"):
        open_link("nocan7")


def test_a_link_waits_for_its_hub() -> None:
    hubs: list[Hub] = []
    opener = threading.Timer(0.2, lambda: hubs.append(Hub("late", ["plant"])))
    opener.start()
    link = open_link("local:late", 5.0)
    assert isinstance(link, LocalLink)
    opener.join()
    link.close()
    hubs[0].close(aborted=True)
