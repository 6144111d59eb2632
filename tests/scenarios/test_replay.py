"""Record, then replay: no difference; the filter removed: as far as two runs say; plant and loop."""

from __future__ import annotations

from pathlib import Path

import cantools
import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.messages import ControllerStatus, PlantMotion
from sil.files.overrides import NO_SETTINGS, Settings
from sil.log_replay.replay import ReplayRequest, ReplayResult, replay
from sil.logs import open_log
from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from tests.scenarios.conftest import ShippedRun

NAMES = sorted(load_scenario.shipped())
SOME = ("bus_off", "full_shift", "late_valve_commands", "strategy_predictive")


def recorded(folder: Path, name: str, settings: Settings = NO_SETTINGS) -> Path:
    folder.mkdir()
    runner.run(load_scenario.load(name, settings=settings), folder)
    return folder / "bus.log"


def require_no_difference(found: ReplayResult, log: Path) -> None:
    assert not found.differs, found.comparison.first
    assert found.comparison.first is None
    assert found.frames == found.account.total == log.read_text().count("\n")
    assert found.comparison.engaged and found.comparison.ticks >= 15
    assert not found.account.other
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


def test_a_loop_that_never_parts_stays_open(shipped_run: ShippedRun) -> None:
    log = shipped_run("lab_n_b")[1] / "bus.log"
    found = replay(ReplayRequest(str(log), closed_loop=True))
    assert not found.differs and found.plant is not None and found.plant.closed_ns is None


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
