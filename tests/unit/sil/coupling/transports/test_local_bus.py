"""The local bus as python-can sees it: a listener to a run."""

from __future__ import annotations

import asyncio
import os
import random
import select
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame
from sil.coupling.transports import address, server, wire
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.local import LocalBus

pytestmark = pytest.mark.usefixtures("runtime_folder")


@pytest.fixture
def hub(runtime_folder: Path) -> Iterator[Hub]:
    """The hub of a run that waits for its controller."""
    hub = Hub("bench", ["controller"])
    yield hub
    hub.close(aborted=True)


def message(number: int) -> can.Message:
    return can.Message(
        arbitration_id=0x0CFF2503, is_extended_id=True, data=number.to_bytes(8, "big")
    )


def content(found: can.Message | None) -> tuple[int, bytes]:
    assert found is not None
    assert found.is_extended_id and not found.is_fd and not found.is_error_frame
    return found.arbitration_id, bytes(found.data)


def local(**options: object) -> can.BusABC:
    return can.Bus(interface="opc4local", channel="bench", ignore_config=True, **options)


@pytest.mark.usefixtures("hub")
def test_python_can_finds_the_interface_by_its_entry_point() -> None:
    with local() as bus:
        assert isinstance(bus, LocalBus)
        assert str(bus).startswith("opc4local ")
    found = can.detect_available_configs("opc4local")
    assert found == [{"interface": "opc4local", "channel": "bench"}]
    with can.Bus(interface="opc4local", ignore_config=True) as only_one:
        assert only_one.fileno() >= 0


@pytest.mark.usefixtures("hub")
def test_timeouts_are_respected() -> None:
    with local() as bus:
        started = time.monotonic()
        assert bus.recv(0.2) is None
        assert time.monotonic() - started >= 0.2
        assert bus.recv(0.0) is None


def test_notifiers_receive_one_message_per_wake_up(hub: Hub) -> None:
    async def listen(bus: can.BusABC) -> list[int]:
        reader = can.AsyncBufferedReader()
        notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())
        hub.deliver([frame(number) for number in range(200)])
        found = [(await asyncio.wait_for(reader.get_message(), 60.0)) for _ in range(200)]
        notifier.stop()
        return [int.from_bytes(each.data, "big") for each in found]

    with local() as bus:
        hub.idle(0.0)
        assert asyncio.run(listen(bus)) == list(range(200))


def test_fileno_shows_when_there_is_something_to_read(hub: Hub) -> None:
    with local() as bus:
        hub.idle(0.0)
        assert select.select([bus], [], [], 0.05)[0] == []
        hub.deliver([frame(3)])
        assert select.select([bus], [], [], 5.0)[0] == [bus]
        assert content(bus.recv(1.0)) == content(message(3))
    assert bus.fileno() == -1


def test_a_closed_bus_says_so(hub: Hub) -> None:
    bus = local()
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.recv(0.0)
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.send(message(1))
    assert hub.warnings == []


def test_without_a_run_there_is_no_bus() -> None:
    with pytest.raises(can.CanInitializationError, match="no run on"):
        LocalBus("nobody")
    with pytest.raises(can.CanInitializationError, match="0 runs found"):
        LocalBus()
    with pytest.raises(can.CanInitializationError, match="expected a name"):
        LocalBus("no such name")


def test_the_end_of_a_run_is_reported() -> None:
    hub = Hub("again", ["controller"])
    bus = LocalBus("again")
    hub.idle(0.0)
    hub.close(aborted=False)
    hub.close(aborted=False)
    for use in (lambda: bus.recv(1.0), lambda: bus.send(message(1))):
        with pytest.raises(can.CanOperationError, match="the run has ended"):
            use()
    bus.shutdown()


def frame(number: int) -> BusFrame:
    return BusFrame(0, number * 1000, "controller", Frame(0x0CFF2503, number.to_bytes(8, "big")))


def test_a_monitor_sees_delivered_frames_at_their_simulated_times(hub: Hub) -> None:
    with LocalBus("bench") as early, LocalBus("bench") as filtered:
        filtered.set_filters([{"can_id": 1, "can_mask": 0x1FFFFFFF}])
        hub.idle(0.0)
        hub.deliver([frame(number) for number in range(1, 4)])
        with LocalBus("bench") as late:
            hub.idle(0.0)
            hub.deliver([frame(4)])
            seen = [early.recv(1.0) for _ in range(4)]
            assert [m.timestamp for m in seen if m] == [1e-6, 2e-6, 3e-6, 4e-6]
            assert content(late.recv(1.0)) == content(seen[3])
            assert filtered.recv(0.1) is None
        hub.idle(0.0)
        hub.deliver([frame(5)])
        assert content(early.recv(1.0))[1] == (5).to_bytes(8, "big")


def test_sending_is_refused_and_a_foreign_frame_is_ignored(hub: Hub) -> None:
    with LocalBus("bench") as monitor, LocalBus("bench") as other:
        hub.idle(0.0)
        with pytest.raises(can.CanOperationError, match="frames from its participants only"):
            monitor.send(message(1))
        assert monitor._connection is not None
        monitor._connection.send(wire.real(Frame(0x0CFF0001, b"")))
        hub.idle(0.05)
        assert other.recv(0.05) is None
    (line,) = hub.warnings
    assert "take no part" in line


def test_a_monitor_that_does_not_read_is_disconnected_and_delays_no_one(
    hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.Server, "most_waiting_bytes", 100_000)
    with LocalBus("bench") as lazy, LocalBus("bench") as busy:
        hub.idle(0.0)
        for number in range(10_000):
            hub.deliver([frame(number)])
            assert content(busy.recv(1.0))[1] == number.to_bytes(8, "big")
        assert "did not read" in hub.warnings[0]
        got = []
        with pytest.raises(can.CanOperationError, match="did not read"):
            while True:
                got.append(content(lazy.recv(1.0))[1])
        assert got == [n.to_bytes(8, "big") for n in range(len(got))], "no hole before the end"
        assert 100 < len(got) < 10_000


def test_a_monitor_that_catches_up_misses_nothing(hub: Hub) -> None:
    with LocalBus("bench") as slow:
        hub.idle(0.0)
        for number in range(5_000):
            hub.deliver([frame(number)])
        found = []
        while len(found) < 5_000:
            hub.idle(0.0)
            while (got := slow.recv(0.0)) is not None:
                found.append(int.from_bytes(got.data, "big"))
        assert found == list(range(5_000))


def test_garbage_never_ends_a_hub(hub: Hub) -> None:
    import socket

    generator = random.Random(7)
    for _ in range(300):
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(str(hub.path))
        for _ in range(generator.randrange(1, 4)):
            stranger.send(generator.randbytes(generator.choice([1, 16, 17, 32, 160, 1024])))
        hub.idle(0.0)
        stranger.close()
    hub.idle(0.05)
    assert len([line for line in hub.warnings if "sent garbage" in line]) > 100
    assert not hub._connections
    with LocalBus("bench") as monitor:
        hub.idle(0.0)
        hub.deliver([frame(1)])
        assert monitor.recv(1.0) is not None


def test_a_name_is_a_socket_in_a_folder_of_this_user_only(runtime_folder: Path) -> None:
    assert address.socket_path("demo") == runtime_folder / "opc4" / "demo.sock"
    assert (runtime_folder / "opc4").stat().st_mode & 0o777 == 0o700
    assert address.socket_path("./here") == Path("here")
    assert address.socket_path(f"{runtime_folder}/b.sock") == runtime_folder / "b.sock"


def test_without_a_runtime_folder_it_is_one_for_temporary_files(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert address.folder() == tmp_path / f"opc4-{os.getuid()}"


@pytest.mark.parametrize("name", ["", ".", "..", "-x", "a b", "a\0b", "ü", "a" * 65, "a\n"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="expected a name of letters"):
        address.socket_path(name)


def test_a_path_too_long_for_a_socket_is_refused() -> None:
    with pytest.raises(InputError, match="expected at most 107 bytes"):
        address.socket_path("/" + "a" * 107)


def test_a_folder_open_to_others_is_refused(runtime_folder: Path) -> None:
    (runtime_folder / "opc4").mkdir()
    (runtime_folder / "opc4").chmod(0o755)
    with pytest.raises(RunError, match="nobody else may enter"):
        address.folder()
    (runtime_folder / "opc4").rmdir()
    (runtime_folder / "opc4").symlink_to(runtime_folder)
    with pytest.raises(RunError, match="nobody else may enter"):
        address.folder()


def test_a_runtime_folder_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    with pytest.raises(RunError, match="missing/opc4: No such file"):
        address.folder()


def test_running_channels_are_those_that_are_listened_to() -> None:
    assert address.running_channels() == []
    one, _ = address.listen("one")
    two, path = address.listen("two")
    assert address.running_channels() == ["one", "two"]
    two.close()
    assert path.is_socket()
    assert address.running_channels() == ["one"]
    one.close()


def test_a_channel_has_one_hub() -> None:
    first, path = address.listen("demo")
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(RunError, match="another run uses it"):
        address.listen("demo")
    first.close()
    again, _ = address.listen("demo")
    again.close()


def test_a_hub_too_busy_to_answer_is_still_there() -> None:
    listener, path = address.listen("demo")
    waiting = []
    while True:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        client.setblocking(False)
        waiting.append(client)
        try:
            client.connect(str(path))
        except BlockingIOError:
            break
    with pytest.raises(RunError, match="another run uses it"):
        address.listen("demo")
    for client in waiting:
        client.close()
    listener.close()


def test_a_file_in_the_way_stays(tmp_path: Path) -> None:
    path = tmp_path / "notes"
    path.write_text("mine")
    with pytest.raises(RunError, match="in use"):
        address.listen(str(path))
    with pytest.raises(InputError, match=r"no folder .*missing; expected an existing one"):
        address.listen(str(tmp_path / "missing" / "x.sock"))
    assert path.read_text() == "mine"
