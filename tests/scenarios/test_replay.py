"""Record, then replay: no difference; the filter removed: as far as two runs say; plant and loop."""

from __future__ import annotations

import gzip
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import cantools
import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.messages import ControllerStatus, PlantMotion
from sil.cli import main
from sil.files.overrides import NO_SETTINGS, Settings
from sil.log_replay.recorded_frames import OWN_IDS
from sil.log_replay.replay import ReplayRequest, ReplayResult, replay
from sil.logs import open_log
from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from tests.conftest import ROOT
from tests.scenarios.conftest import ShippedRun
from tests.support.replay_cost import made_log, peak_memory

NAMES = sorted(load_scenario.shipped())
SOME = ("bus_off", "full_shift", "late_valve_commands", "strategy_predictive")


def recorded(folder: Path, name: str, settings: Settings = NO_SETTINGS) -> Path:
    folder.mkdir()
    runner.run(load_scenario.load(name, settings=settings), folder)
    return folder / "bus.log"


def require_no_difference(found: ReplayResult, log: Path) -> None:
    assert not found.differs, found.comparison.first
    assert found.comparison.first is None
    assert found.frames == found.account.total() == log.read_text().count("\n")
    assert found.comparison.engaged and found.comparison.ticks >= 15
    uses = {"inputs", "answers of the control unit", "of the plant", "foreign"}
    assert found.account.keys() <= uses | {"inputs while off the bus"}
    for result in found.comparison.matched_edges():
        assert not result.lines(1)


@pytest.mark.parametrize("name", SOME)
def test_a_recorded_run_replays_without_a_difference(name: str, shipped_run: ShippedRun) -> None:
    log = shipped_run(name)[1] / "bus.log"
    require_no_difference(replay(ReplayRequest(str(log))), log)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_shipped_scenario_replays_without_a_difference(
    name: str, shipped_run: ShippedRun
) -> None:
    log = shipped_run(name)[1] / "bus.log"
    found = replay(ReplayRequest(str(log), plant=True))
    require_no_difference(found, log)
    assert found.plant is not None
    assert found.plant.compared > 200 and not found.plant.differing and not found.plant.unmatched


def coil_edges_ns(log: Path, period_ns: int) -> dict[tuple[str, bool], list[int]]:
    """Ticks at which coils switch, from the frames alone: another decoder, another bookkeeping."""
    database = cantools.database.load_file(DBC_PATH)
    valves, blow = (database.get_message_by_name(n) for n in ("ValveCommand", "SafetyBlow"))
    by_tick: dict[int, dict[str, bool]] = {}
    for frame in open_log(log):
        tick = frame.time_ns // period_ns
        if frame.can_id == valves.frame_id:
            signals = valves.decode(frame.data, decode_choices=False)
            for c in "BNF":
                by_tick.setdefault(tick, {})[c] = signals[f"Duty{c}"] > 33.0
        elif frame.can_id == blow.frame_id:
            signals = blow.decode(frame.data, decode_choices=False)
            if signals["BlowActive"]:
                by_tick[tick]["BNF"[int(signals["BlowChamber"])]] = True
    edges: dict[tuple[str, bool], list[int]] = {}
    before = dict.fromkeys("BNF", False)
    for tick in sorted(by_tick):
        for c, on in by_tick[tick].items():
            if on is not before[c]:
                edges.setdefault((c, on), []).append(tick * period_ns)
                before[c] = on
    return edges


@pytest.mark.parametrize("name", ["lab_n_b", "lab_b_n", "full_shift", "truck_into_gear_easy"])
def test_the_filter_removed_moves_every_edge_as_two_runs_say(
    name: str, shipped_run: ShippedRun, tmp_path: Path
) -> None:
    with_filter = shipped_run(name)[1] / "bus.log"
    without = recorded(tmp_path / "without", name, {"controller.filter": False})
    found = replay(ReplayRequest(str(with_filter), settings={"controller.filter": False}))
    period_ns = found.grid.period_ns
    a, b = coil_edges_ns(with_filter, period_ns), coil_edges_ns(without, period_ns)
    assert a.keys() == b.keys() and len(a) >= 2
    moved = 0
    for result in found.comparison.matched_edges()[:3]:
        chamber = result.signal.name[-1]
        assert not result.matching.dropped and not result.matching.added
        for up in (True, False):
            moves = [
                shift
                for (i, _), shift in zip(result.matching.pairs, result.shift_ns, strict=True)
                if result.signal.recorded[i].up is up
            ]
            runs = [
                y - x
                for x, y in zip(a.get((chamber, up), []), b.get((chamber, up), []), strict=True)
            ]
            assert moves == runs
            moved += sum(1 for shift in moves if shift)
    assert moved >= 1


@pytest.mark.parametrize(
    ("name", "settings", "closed_ns"),
    [
        ("full_shift", {"controller.filter": False}, 210_000_000),
        ("firmware_2500us", {"controller.filter": True}, 147_500_000),
        ("busy_bus", {"controller.blow.duration_s": 0.05}, 250_000_000),
    ],
)
def test_the_loop_closed_gives_what_a_run_of_that_firmware_gives(
    name: str, settings: Settings, closed_ns: int, shipped_run: ShippedRun
) -> None:
    """Bit by bit: the position that the plant published, and every state at its tick."""
    log = shipped_run(name)[1] / "bus.log"
    found = replay(ReplayRequest(str(log), settings=settings, closed_loop=True))
    assert found.plant is not None and found.plant.closed_ns == closed_ns
    run = run_in_memory(load_scenario.load(name, settings=settings)).record
    positions = [motion.position_m for _, motion in run.of(PlantMotion)]
    assert [p.replayed_m for p in found.plant.positions][: len(positions)] == positions
    period_ns, states = found.grid.period_ns, []
    for entry, status in run.of(ControllerStatus):
        if not states or states[-1][1] != status.state.name:
            states.append((entry.released_ns // period_ns * period_ns, status.state.name))
    assert found.comparison.states[0].sides[1] == states


def test_a_plant_that_is_another_is_reported_from_a_unit_that_is_another(
    shipped_run: ShippedRun,
) -> None:
    log = shipped_run("lab_n_b")[1] / "bus.log"
    plant = replay(ReplayRequest(str(log), settings={"valve.D_fall": 0.02}, plant=True))
    assert plant.plant is not None
    assert not plant.comparison.differs and plant.plant.differing > 0 and plant.differs
    heavier = replay(ReplayRequest(str(log), settings={"length.m_s": 8.0}, plant=True))
    assert heavier.plant is not None and heavier.plant.first is not None
    assert heavier.plant.first[0] > 110_000_000  # not before the valve opened
    assert heavier.plant.largest["PlantMotion.position_m"] > 1e-4
    unit = replay(ReplayRequest(str(log), settings={"controller.filter": False}, plant=True))
    assert unit.plant is not None and unit.comparison.differs and not unit.plant.differing


Run = Callable[..., subprocess.CompletedProcess[str]]


def test_a_run_replayed_as_it_was_and_without_its_filter(opc4: Run, tmp_path: Path) -> None:
    assert opc4("run", "lab_n_b", "--out", "run", "--no-report").returncode == 0

    same = opc4("replay", "run/bus.log", "--out", "same")
    assert same.returncode == 0, same.stderr
    assert "no difference" in same.stdout
    output = json.loads((tmp_path / "same/diff.json").read_text())
    assert output["differs"] is False
    assert output["frames"]["accounted"] == output["frames"]["total"] > 500

    changed = opc4("replay", "run/bus.log", "--set", "controller.filter=false", "--out", "changed")
    assert changed.returncode == 1, changed.stderr
    assert "earlier" in changed.stdout and "samples" in changed.stdout
    for name in ("diff.json", "diff.txt", "report.html"):
        assert (tmp_path / "changed" / name).stat().st_size > 0
    assert "first difference" in (tmp_path / "changed/diff.txt").read_text()


def test_a_log_in_which_nothing_was_engaged_is_no_success(opc4: Run, tmp_path: Path) -> None:
    (tmp_path / "idle.log").write_text("(0000000000.000500) can0 123#00\n")
    refused = opc4("replay", "idle.log")
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1 and "idle.log" in refused.stderr


def test_a_log_with_other_identifiers_needs_their_database(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every identifier of ours moved to another source address, in the log and in the DBC."""
    dbc = Path(DBC_PATH).read_text(encoding="ascii")
    log = gzip.decompress((ROOT / "tests/golden/lab_n_b.log.gz").read_bytes()).decode()
    for can_id in OWN_IDS:
        other = can_id ^ 0x40
        dbc = dbc.replace(str(can_id | 1 << 31), str(other | 1 << 31))
        log = log.replace(f" {can_id:08X}#", f" {other:08X}#")
    database, recorded = tmp_path / "other.dbc", tmp_path / "other.log"
    database.write_text(dbc, encoding="ascii")
    recorded.write_text(log)
    call = ["replay", str(recorded), "--out", str(tmp_path / "out"), "--json"]
    assert main(call) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "truck"  # of whichever control unit
    assert main([*call, "--dbc", str(database), "--force"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["ticks"] == 70 and "foreign" not in output["frames"]["uses"]


def test_tolerances_from_a_file_and_a_folder_that_is_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = tmp_path / "options.toml"
    options.write_text('ignore = ["*"]\n')
    log, out = str(ROOT / "tests/golden/lab_n_b.log.gz"), str(tmp_path / "out")
    what_if = ["replay", log, "--set", "controller.filter=false", "--out", out]
    assert main([*what_if, "--options", str(options)]) == 0
    assert main(what_if) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*what_if, "--force"]) == 1


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    short, long = (made_log(tmp_path / f"{s}.log", s) for s in (30, 90))
    for what in ("read", "replay"):
        (few, low), (many, high) = peak_memory(what, short), peak_memory(what, long)
        assert many == 3 * few
        assert high < 1.1 * low


@pytest.mark.slow
def test_a_log_alone_says_what_is_missing_or_finds_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def replayed(name: str, log: bytes) -> tuple[int, str]:
        (tmp_path / f"{name}.log").write_bytes(log)
        code = main(["replay", str(tmp_path / f"{name}.log"), "--out", str(tmp_path / name)])
        return code, capsys.readouterr().out

    for name in ("filter_off", "truck_torque_to_torque"):
        golden = gzip.decompress((ROOT / f"tests/golden/{name}.log.gz").read_bytes())
        code, text = replayed(name, golden)
        assert code == 0 and f"found by trying the shipped ones: those of {name}" in text
    words = ["run", "lab_n_b", "--set", "controller.windows.samples=7"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    code, text = replayed("own", (tmp_path / "run" / "bus.log").read_bytes())
    assert code == 1
    first = text.splitlines()[0]
    assert "nothing says which settings the recorded firmware had, and 11 shipped ones" in first
    assert first.index("cannot be compared") < first.index("ticks differ")
