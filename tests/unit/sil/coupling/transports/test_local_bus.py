"""The local bus as python-can sees it: its contract on a plain bus, and as a monitor of a run."""

from __future__ import annotations

import asyncio
import random
import select
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_dbc.frame import EDP_BIT, Frame
from sil.coupling.bus import Delivery
from sil.coupling.transports import hub as hub_module
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.local import LocalBus


@pytest.fixture(autouse=True)
def _runtime(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("r")))


@pytest.fixture
def plain_bus() -> Iterator[Hub]:
    """A bus without a run, served by a thread."""
    hub = Hub("plain")
    stop = threading.Event()
    server = threading.Thread(target=hub.serve, args=(stop,))
    server.start()
    yield hub
    stop.set()
    server.join()
    hub.close(aborted=False)


def message(number: int, length: int = 8) -> can.Message:
    return can.Message(
        arbitration_id=0x0CFF0000 + (number & 0xFFFF),
        is_extended_id=True,
        data=number.to_bytes(8, "little")[:length],
    )


def content(found: can.Message | None) -> tuple[int, bytes]:
    assert found is not None
    assert found.is_extended_id and not found.is_fd and not found.is_error_frame
    return found.arbitration_id, bytes(found.data)


def drain(bus: can.BusABC, count: int) -> list[tuple[int, bytes]]:
    return [content(bus.recv(10.0)) for _ in range(count)]


def local(**options: object) -> can.BusABC:
    return can.Bus(interface="opc4local", channel="plain", ignore_config=True, **options)


@pytest.mark.usefixtures("plain_bus")
def test_python_can_finds_the_interface_by_its_entry_point() -> None:
    with local() as bus:
        assert isinstance(bus, LocalBus)
        assert str(bus).startswith("opc4local ")
    found = can.detect_available_configs("opc4local")
    assert found == [{"interface": "opc4local", "channel": "plain"}]
    with can.Bus(interface="opc4local", ignore_config=True) as only_one:
        assert only_one.fileno() >= 0


@pytest.mark.usefixtures("plain_bus")
def test_everybody_but_the_sender_gets_every_message_in_order() -> None:
    with local() as first, local() as second, local() as third:
        sent = [message(number, number % 9) for number in range(300)]
        for each in sent:
            first.send(each)
        expected = [(m.arbitration_id, bytes(m.data)) for m in sent]
        assert drain(second, 300) == expected
        assert drain(third, 300) == expected
        assert first.recv(0.0) is None
        second.send(message(1))
        assert content(first.recv(1.0)) == content(third.recv(1.0)) == content(message(1))
        assert second.recv(0.05) is None


@pytest.mark.usefixtures("plain_bus")
def test_timeouts_are_kept() -> None:
    with local() as bus, local() as other:
        started = time.monotonic()
        assert bus.recv(0.2) is None
        assert 0.2 <= time.monotonic() - started < 1.0
        assert bus.recv(0.0) is None
        late = threading.Timer(0.2, other.send, (message(5),))
        late.start()
        before = time.time()
        received = bus.recv(None)
        assert content(received) == content(message(5))
        assert received is not None and before < received.timestamp < time.time() + 1.0
        late.join()


@pytest.mark.usefixtures("plain_bus")
def test_own_messages_come_back_when_asked_for() -> None:
    with local(receive_own_messages=True) as bus, local() as other:
        bus.send(message(1))
        other.send(message(2))
        assert sorted(drain(bus, 2)) == [content(message(1)), content(message(2))]
        assert drain(other, 1) == [content(message(1))]


@pytest.mark.usefixtures("plain_bus")
def test_filters_select() -> None:
    filters = [{"can_id": 0x0CFF0002, "can_mask": 0x1FFFFFFF, "extended": True}]
    with local(can_filters=filters) as bus, local() as other:
        for number in range(5):
            other.send(message(number))
        assert drain(bus, 1) == [content(message(2))]
        assert bus.recv(0.1) is None
        bus.set_filters(None)
        other.send(message(4))
        assert drain(bus, 1) == [content(message(4))]


@pytest.mark.usefixtures("plain_bus")
def test_a_burst_of_ten_thousand_arrives_whole_though_nobody_reads_meanwhile() -> None:
    with local() as bus, local() as other:
        for number in range(10_000):
            bus.send(message(number))
        assert drain(other, 10_000) == [content(message(number)) for number in range(10_000)]


@pytest.mark.usefixtures("plain_bus")
def test_notifiers_get_one_message_per_wake_up() -> None:
    async def listen(bus: can.BusABC, other: can.BusABC) -> list[int]:
        reader = can.AsyncBufferedReader()
        notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())
        for number in range(200):
            other.send(message(number))
        found = [(await asyncio.wait_for(reader.get_message(), 5.0)) for _ in range(200)]
        notifier.stop()
        return [each.arbitration_id for each in found]

    with local() as bus, local() as other:
        assert asyncio.run(listen(bus, other)) == [0x0CFF0000 + n for n in range(200)]
        printed: list[can.Message] = []
        notifier = can.Notifier(bus, [printed.append])
        other.send(message(7))
        deadline = time.monotonic() + 5.0
        while not printed and time.monotonic() < deadline:
            time.sleep(0.01)
        notifier.stop()
        assert [content(each) for each in printed] == [content(message(7))]


@pytest.mark.usefixtures("plain_bus")
def test_periodic_sending_works() -> None:
    with local() as bus, local() as other:
        task = bus.send_periodic(message(9), 0.01)
        assert drain(other, 5) == [content(message(9))] * 5
        task.stop()


@pytest.mark.usefixtures("plain_bus")
def test_fileno_tells_when_there_is_something_to_read() -> None:
    with local() as bus, local() as other:
        assert select.select([bus], [], [], 0.05)[0] == []
        other.send(message(3))
        assert select.select([bus], [], [], 5.0)[0] == [bus]
        assert drain(bus, 1) == [content(message(3))]
    assert bus.fileno() == -1


@pytest.mark.parametrize(
    "wrong",
    [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"1"),
        can.Message(arbitration_id=0x123, is_remote_frame=True),
        can.Message(arbitration_id=0x123, is_error_frame=True),
        can.Message(arbitration_id=0x123, is_fd=True, data=bytes(12)),
        can.Message(arbitration_id=0x123 | EDP_BIT, data=b"1"),
    ],
    ids=["11 bits", "remote", "error", "fd", "lockstep"],
)
@pytest.mark.usefixtures("plain_bus")
def test_what_cannot_be_carried_is_refused(wrong: can.Message) -> None:
    with local() as bus, local() as other:
        with pytest.raises(can.CanOperationError, match=r"(cannot carry|lockstep)"):
            bus.send(wrong)
        bus.send(message(1))
        assert drain(other, 1) == [content(message(1))]


def test_a_closed_bus_says_so(plain_bus: Hub) -> None:
    bus = local()
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.recv(0.0)
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.send(message(1))
    assert plain_bus.counts.warnings == []


def test_without_a_hub_there_is_no_bus() -> None:
    with pytest.raises(can.CanInitializationError, match="no hub on"):
        LocalBus("nobody")
    with pytest.raises(can.CanInitializationError, match="0 buses run"):
        LocalBus()
    with pytest.raises(can.CanInitializationError, match="expected a name"):
        LocalBus("no such name")


def test_the_end_of_the_hub_ends_its_clients_and_a_new_one_serves_again() -> None:
    hub = Hub("again")
    bus = LocalBus("again")
    hub.idle(0.0)
    hub.close(aborted=False)
    hub.close(aborted=False)
    with pytest.raises(can.CanOperationError, match="the run has ended"):
        bus.recv(1.0)
    with pytest.raises(can.CanOperationError, match="the run has ended"):
        bus.send(message(1))
    bus.shutdown()
    with Serving("again"), LocalBus("again") as first, LocalBus("again") as second:
        first.send(message(1))
        assert drain(second, 1) == [content(message(1))]


class Serving:
    """A plain bus for a while."""

    def __init__(self, channel: str) -> None:
        self.hub = Hub(channel)
        self.stop = threading.Event()
        self.server = threading.Thread(target=self.hub.serve, args=(self.stop,))

    def __enter__(self) -> Hub:
        self.server.start()
        return self.hub

    def __exit__(self, *ignored: object) -> None:
        self.stop.set()
        self.server.join()
        self.hub.close(aborted=False)


def run_hub(channel: str) -> Hub:
    """A hub of a run that waits for its controller."""
    return Hub(channel, ["controller"])


def frame(number: int) -> Delivery:
    return Delivery(number * 1000, Frame(0x0CFF2503, number.to_bytes(8, "big")), "controller", 0)


def test_a_monitor_sees_delivered_frames_at_their_simulated_times() -> None:
    hub = run_hub("run")
    try:
        with LocalBus("run") as early, LocalBus("run") as filtered:
            filtered.set_filters([{"can_id": 1, "can_mask": 0x1FFFFFFF}])
            hub.idle(0.0)
            hub.deliver([frame(number) for number in range(1, 4)])
            with LocalBus("run") as late:
                hub.idle(0.0)
                hub.deliver([frame(4)])
                seen = [early.recv(1.0) for _ in range(4)]
                assert [m.timestamp for m in seen if m] == [1e-6, 2e-6, 3e-6, 4e-6]
                assert content(late.recv(1.0)) == content(seen[3])
                assert filtered.recv(0.1) is None
            hub.idle(0.0)
            hub.deliver([frame(5)])
            assert content(early.recv(1.0))[1] == (5).to_bytes(8, "big")
    finally:
        hub.close(aborted=True)


def test_a_run_takes_no_frames_from_monitors_and_tells_them() -> None:
    hub = run_hub("run")
    try:
        with LocalBus("run") as monitor, LocalBus("run") as other:
            hub.idle(0.0)
            monitor.send(message(1))
            monitor.send(message(2))
            hub.idle(0.05)
            with pytest.raises(can.CanOperationError, match="frames from its participants only"):
                monitor.recv(1.0)
            with pytest.raises(can.CanOperationError, match="frames from its participants only"):
                monitor.send(message(3))
            assert other.recv(0.05) is None
        assert hub.counts.foreign_frames == 2
        assert "take no part" in hub.counts.warnings[0]
    finally:
        hub.close(aborted=True)


def test_a_monitor_that_does_not_read_is_let_go_and_holds_nobody_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hub_module, "MONITOR_BACKLOG_BYTES", 100_000)
    hub = run_hub("run")
    try:
        with LocalBus("run") as lazy, LocalBus("run") as busy:
            hub.idle(0.0)
            started = time.monotonic()
            for number in range(10_000):
                hub.deliver([frame(number)])
                assert content(busy.recv(1.0))[1] == number.to_bytes(8, "big")
            assert time.monotonic() - started < 10.0
            assert hub.counts.monitors_dropped == 1
            assert "did not read" in hub.counts.warnings[0]
            got = []
            with pytest.raises(can.CanOperationError, match="did not read"):
                while True:
                    got.append(content(lazy.recv(1.0))[1])
            assert got == [n.to_bytes(8, "big") for n in range(len(got))], "no hole before the end"
            assert 100 < len(got) < 10_000
    finally:
        hub.close(aborted=True)


def test_a_monitor_that_catches_up_misses_nothing() -> None:
    hub = run_hub("run")
    try:
        with LocalBus("run") as slow:
            hub.idle(0.0)
            for number in range(5_000):
                hub.deliver([frame(number)])
            found = []
            while len(found) < 5_000:
                hub.idle(0.0)
                while (got := slow.recv(0.0)) is not None:
                    found.append(int.from_bytes(got.data, "big"))
            assert found == list(range(5_000))
    finally:
        hub.close(aborted=True)


def test_garbage_never_ends_a_hub(tmp_path: Path) -> None:
    import socket

    generator = random.Random(7)
    hub = run_hub("run")
    try:
        for _ in range(300):
            stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            stranger.connect(str(hub.path))
            for _ in range(generator.randrange(1, 4)):
                stranger.send(generator.randbytes(generator.choice([1, 16, 17, 32, 160, 1024])))
            hub.idle(0.0)
            stranger.close()
        hub.idle(0.05)
        assert hub.counts.garbage > 250
        with LocalBus("run") as monitor:
            hub.idle(0.0)
            hub.deliver([frame(1)])
            assert monitor.recv(1.0) is not None
    finally:
        hub.close(aborted=True)
