"""What every transport keeps: one suite over calls, the local bus and a CAN channel."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from pathlib import Path

import pytest

from can_dbc.errors import RunError
from sil.coupling.faults import (
    BusFault,
    BusOff,
    Dead,
    Delay,
    DetectedCorruption,
    FrozenCounter,
    Loss,
    Stalled,
    UndetectedCorruption,
)
from sil.coupling.processes import ChildProcess
from sil.coupling.real_time import Pacer
from sil.coupling.transports import address
from sil.coupling.transports.channel import ParticipantLost, Timeouts
from sil.coupling.transports.socketcan import CanSocket
from sil.recording.recorder import BUS_LOG, PLANT_TRACE
from sil.recording.run_reader import open_trace
from tests.contracts.toy_nodes import COLUMNS, IDS, MS, PERIODS_NS, PHASES_NS
from tests.contracts.toy_run import channel_name, command, toy_run

END_NS = 300 * MS + 1
VCAN = pytest.param("vcan0", marks=pytest.mark.vcan)

every_transport = pytest.mark.parametrize("transport", ["inproc", "local", VCAN])
every_remote_transport = pytest.mark.parametrize("transport", ["local", VCAN])

pytestmark = pytest.mark.usefixtures("runtime_folder")


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the toy run in one process."""
    with toy_run("inproc", tmp_path_factory.mktemp("reference") / "run", END_NS) as run:
        run.lockstep.run()
    return run.sha256()


def test_the_hash_sees_every_part_of_a_run(tmp_path: Path, reference: str) -> None:
    with toy_run("inproc", tmp_path / "shorter", END_NS - 10 * MS) as run:
        run.lockstep.run()
    assert run.sha256() != reference
    with toy_run("inproc", tmp_path / "again", END_NS) as run:
        run.lockstep.run()
    assert run.sha256() == reference
    with open(run.folder / PLANT_TRACE, "r+b") as trace:
        trace.seek(-1, os.SEEK_END)
        last = trace.read(1)
        trace.seek(-1, os.SEEK_END)
        trace.write(bytes([last[0] ^ 1]))
    assert run.sha256() != reference


@every_transport
def test_same_hash_as_in_one_process(transport: str, tmp_path: Path, reference: str) -> None:
    cores = os.sched_getaffinity(0)
    with toy_run(transport, tmp_path / "run", END_NS) as run:
        summary = run.lockstep.run()
    assert run.sha256() == reference
    assert run.lockstep.warnings == []
    assert os.sched_getaffinity(0) == cores
    assert summary.frames == len((run.folder / BUS_LOG).read_text().splitlines()) > 200
    trace = open_trace(run.folder / PLANT_TRACE)
    assert trace.dtype.names == COLUMNS
    assert len(trace) == 1 + 60 == len(set(trace[COLUMNS[0]])), "once per event and at the end"


@every_transport
def test_same_hash_in_pieces(transport: str, tmp_path: Path, reference: str) -> None:
    with toy_run(transport, tmp_path / "run", END_NS) as run:
        run.lockstep.advance(7 * MS)
        run.lockstep.advance(7 * MS)
        run.lockstep.advance(100 * MS)
        assert run.lockstep.now_ns == 100 * MS
        run.lockstep.run()
    assert run.sha256() == reference


@every_transport
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_same_hash_in_real_time(
    transport: str, factor: float, tmp_path: Path, reference: str
) -> None:
    with toy_run(transport, tmp_path / "run", END_NS, pacer=Pacer(factor)) as run:
        run.lockstep.start()
        started = time.monotonic()
        summary = run.lockstep.run()
        took = time.monotonic() - started
    assert run.sha256() == reference
    assert took >= END_NS / 1e9 / factor
    assert summary.lateness.instants > 60
    assert summary.lateness.max_s >= summary.lateness.p99_s >= summary.lateness.p50_s >= 0.0


@every_transport
def test_a_burst_of_ten_thousand_frames_arrives_whole(transport: str, tmp_path: Path) -> None:
    """The controller offers 10,000 frames at its first event, and again at the next ones."""
    options = {"controller": ["--burst", "10000"]}
    counts = []
    for folder, kind in (("expected", "inproc"), ("run", transport)):
        with toy_run(kind, tmp_path / folder, 12 * MS, options=options) as run:
            run.lockstep.run()
        counts.append((run.log.frames, run.bus.waiting, run.sha256()))
    assert counts[0] == counts[1]
    assert counts[0][0] + counts[0][1] > 30_000
    assert run.bus.load > 0.99


@every_transport
def test_a_participant_that_is_dead_in_the_simulation_is_silent(
    transport: str, tmp_path: Path
) -> None:
    hashes = []
    for folder, kind in (("expected", "inproc"), ("run", transport)):
        with toy_run(
            kind, tmp_path / folder, END_NS, faults=[Dead(node="controller", start_s=0.05)]
        ) as run:
            run.lockstep.run()
        hashes.append(run.sha256())
        lines = (run.folder / BUS_LOG).read_text().splitlines()
        last = [line for line in lines if f" opc4 {IDS['controller']:08X}#" in line][-1]
        assert 0.040 < float(last[1:18]) < 0.050
        assert len(lines) == 2 * (15 + 60 + 5), "the others went on"
    assert hashes[0] == hashes[1]


FAULTS: list[BusFault] = [
    Loss(message="PositionPulse", probability=0.3),
    DetectedCorruption(message="ShiftRequest", every=3, attempts=2),
    UndetectedCorruption(message="ValveCommand", probability=0.5, bits=3, end_s=0.1),
    Delay(message="PositionPulse", delay_s=0.002, jitter_s=0.004, start_s=0.1),
    FrozenCounter(message="ValveCommand", start_s=0.15),
    BusOff(node="controller", start_s=0.2, end_s=0.2301),
    BusOff(node="driver", start_s=0.2, end_s=0.2601),
    Stalled(node="controller", start_s=0.25, end_s=0.2705),
]


@every_transport
def test_faults_are_the_same_everywhere(transport: str, tmp_path: Path, reference: str) -> None:
    hashes = []
    for folder, kind in (("expected", "inproc"), ("run", transport)):
        with toy_run(kind, tmp_path / folder, END_NS, faults=FAULTS) as run:
            run.lockstep.run()
        hashes.append(run.sha256())
        assert all(hits > 3 for hits in run.plan.hits.values())
        assert len(run.plan.hits) == 5
    assert hashes[0] == hashes[1] != reference


@every_remote_transport
@pytest.mark.parametrize("name", ["plant", "controller"])
def test_kill_9_ends_the_run_at_once(transport: str, name: str, tmp_path: Path) -> None:
    options = {name: ["--at", str(100 * MS), "slow"]}
    timeouts = Timeouts(start_s=60.0, answer_s=600.0)  # the death is noticed, not an answer missed
    end_ns = 3600 * 1000 * MS
    with toy_run(transport, tmp_path / "run", end_ns, options=options, timeouts=timeouts) as run:
        run.lockstep.advance(200 * MS)
        killer = threading.Timer(0.3, os.kill, (run.children[name].pid, signal.SIGKILL))
        killer.start()
        with pytest.raises(
            ParticipantLost, match=rf"^{name} was killed by SIGKILL \(at \d"
        ) as lost:
            run.lockstep.run()
    assert lost.value.participant == name
    assert run.lockstep.now_ns > 200 * MS
    lines = (run.folder / BUS_LOG).read_text().splitlines()
    assert len(lines) == run.log.frames
    assert float(lines[-1][1:18]) * 1e9 > run.lockstep.now_ns - 10 * MS
    last_s = open_trace(run.folder / PLANT_TRACE)[COLUMNS[0]][-1]
    assert last_s * 1e9 > run.lockstep.now_ns - 10 * MS
    for child in run.children.values():
        with pytest.raises(ProcessLookupError):
            os.kill(child.pid, 0)


@every_remote_transport
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("stall", "controller did not answer within 0.5 s: it stalled"),
        ("exit", "controller ended with exit status 7"),
        (
            "fail",
            "controller (failed|ended with exit status 1: ValueError: toy node asked to fail)",
        ),
    ],
)
def test_what_goes_wrong_is_named(transport: str, what: str, message: str, tmp_path: Path) -> None:
    options = {"controller": ["--at", str(50 * MS), what]}
    timeouts = Timeouts(start_s=20.0, answer_s=0.5)
    with (
        toy_run(transport, tmp_path / "run", END_NS, options=options, timeouts=timeouts) as run,
        pytest.raises(ParticipantLost, match=message),
    ):
        run.lockstep.run()
    assert run.lockstep.now_ns == 50 * MS
    for child in run.children.values():
        with pytest.raises(ProcessLookupError):
            os.kill(child.pid, 0)


@every_remote_transport
def test_a_stopped_process_is_missed(transport: str, tmp_path: Path) -> None:
    with toy_run(transport, tmp_path / "run", 3600 * 1000 * MS) as run:
        run.lockstep.advance(100 * MS)
        os.kill(run.children["plant"].pid, signal.SIGSTOP)
        with pytest.raises(ParticipantLost, match=r"^plant did not answer"):
            run.lockstep.run()


@every_remote_transport
def test_a_late_starter_is_waited_for(transport: str, tmp_path: Path, reference: str) -> None:
    said: list[str] = []

    def start_it(message: str) -> None:
        said.append(message)
        run.remote.spawn("controller", command("controller", channel_name(transport)))

    with toy_run(transport, tmp_path / "run", END_NS, external=["controller"], say=start_it) as run:
        run.lockstep.run()
    assert run.sha256() == reference
    assert len(said) == 1 and said[0].startswith("waiting for controller")
    assert said[0].endswith(f"to join (--channel {channel_name(transport)})")


@every_remote_transport
def test_who_never_comes_is_named(transport: str, tmp_path: Path) -> None:
    timeouts = Timeouts(start_s=0.5)
    with (
        toy_run(
            transport, tmp_path / "run", END_NS, external=["controller", "plant"], timeouts=timeouts
        ) as run,
        pytest.raises(ParticipantLost, match=r"(controller|plant) did not join within 0.5 s"),
    ):
        run.lockstep.run()


@every_remote_transport
@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("controller", (), "a participant of this name has joined already"),
        ("driver", (), "the run waits for no participant of this name"),
        ("plant", ("--scenario", "4711"), "(joined already|runs another scenario)"),
    ],
)
def test_an_unsuited_participant_is_refused_and_changes_nothing(
    transport: str, name: str, options: tuple[str, ...], reason: str, tmp_path: Path, reference: str
) -> None:
    with toy_run(transport, tmp_path / "run", END_NS, scenario=4710) as run:
        run.lockstep.advance(100 * MS)
        second = ChildProcess(name, command(name, channel_name(transport), *options))
        while (ended := second.how_it_ended(0.0)) is None:
            run.remote.idle(0.02)
        second.end(0.0)
        run.lockstep.run()
    assert "refused" in ended
    assert run.sha256() == reference
    assert len(run.lockstep.warnings) == 1
    assert reason.strip("()").split("|")[0] in run.lockstep.warnings[0]


@every_remote_transport
def test_another_scenario_is_refused(transport: str, tmp_path: Path) -> None:
    options = {"controller": ["--scenario", "2"]}
    with (
        toy_run(transport, tmp_path / "run", END_NS, options=options, scenario=1) as run,
        pytest.raises(ParticipantLost, match="refused: the coordinator runs another scenario"),
    ):
        run.lockstep.run()


@every_remote_transport
def test_a_second_run_on_the_channel_is_refused(transport: str, tmp_path: Path) -> None:
    with toy_run(transport, tmp_path / "run", END_NS) as run:
        run.lockstep.advance(10 * MS)
        with (
            pytest.raises(RunError, match="another run uses it"),
            toy_run(transport, tmp_path / "second", END_NS),
        ):
            raise AssertionError("the channel was opened twice")
        run.lockstep.run()


@every_remote_transport
def test_the_channel_is_free_again_after_a_run_that_was_killed(
    transport: str, tmp_path: Path, reference: str
) -> None:
    with toy_run(transport, tmp_path / "run", END_NS) as run:
        run.lockstep.advance(100 * MS)
        os.kill(run.children["controller"].pid, signal.SIGKILL)
        with pytest.raises(ParticipantLost):
            run.lockstep.run()
    with toy_run(transport, tmp_path / "next", END_NS) as run:
        run.lockstep.run()
    assert run.sha256() == reference


GARBAGE = [b"x", b"\xff" * 15, b"\xff" * 16, b"\x00" * 32, b"\xa5" * 40000, os.urandom(160)]


@pytest.mark.parametrize("garbage", GARBAGE, ids=len)
def test_garbage_from_a_stranger_closes_its_connection_only(
    garbage: bytes, tmp_path: Path, reference: str
) -> None:
    with toy_run("local", tmp_path / "run", END_NS) as run:
        run.lockstep.advance(100 * MS)
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(str(address.socket_path(channel_name("local").removeprefix("local:"))))
        stranger.send(garbage)
        run.lockstep.run()
        stranger.settimeout(1.0)
        while stranger.recv(4096):
            pass
        stranger.close()
    assert run.sha256() == reference
    (line,) = run.lockstep.warnings
    assert "garbage" in line


@pytest.mark.vcan
def test_foreign_frames_on_a_can_channel_are_reported_and_change_nothing(
    tmp_path: Path, reference: str
) -> None:
    from can_dbc.frame import Frame
    from sil.coupling.transports import wire

    with toy_run("vcan0", tmp_path / "run", END_NS) as run:
        run.lockstep.start()
        stranger = CanSocket("vcan0", ())
        for now_ns in range(0, 300 * MS, 10 * MS):
            run.lockstep.advance(now_ns)
            for frame in (Frame(0x0CFF0105, b"\x00" * 8), Frame(0x18FEF100, os.urandom(8))):
                stranger.send(wire.real(frame))
        stranger.close()
        run.lockstep.run()
    assert run.sha256() == reference
    (line,) = run.lockstep.warnings
    assert "take no part" in line


@every_transport
def test_participants_are_granted_their_own_events_and_the_end_only(
    transport: str, tmp_path: Path
) -> None:
    with toy_run(transport, tmp_path / "run", END_NS) as run:
        run.lockstep.run()
    node = run.nodes["driver"]
    own = list(range(PHASES_NS["driver"], END_NS, PERIODS_NS["driver"]))
    assert node.instants == [*own, END_NS] and node.heard > 100
    assert node.closed
