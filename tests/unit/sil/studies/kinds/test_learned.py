"""Trucks in sequence: draws by seed and truck alone, the same for all strategies and workers."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from can_dbc.errors import InputError
from controller.strategies.into_gear import Command, Progress
from controller.strategies.learned import Learned
from sil.cli import main
from sil.studies.fleet import Drawn, FleetTable, Truck, truck_table
from sil.studies.kinds import learned
from sil.studies.kinds.learned import Outcome
from sil.studies.load_study import SHIPPED, load_study
from sil.studies.table import read_table, row_groups
from tests.bench.strategies import operations

SHIPPED_STUDY = SHIPPED / "learned.toml"
NOMINAL = dict(zip(Truck.NOMINAL, (0.008, 0.035, 0.004, 0.0293, 0.09, 0.25), strict=True))
POPULATION = load_study("learned").study
TABLE = POPULATION.truck


def small(folder: Path, **fleet: int) -> Path:
    """Write the shipped study with fewer trucks and shifts."""
    fleet = {"trucks": 2, "shifts": 3, "seed": 1, "examined_after": 0, "exchanged_at": 0} | fleet
    before, rest = SHIPPED_STUDY.read_text().split("[fleet]")
    path = folder / "small.toml"
    numbers = "\n".join(f"{name} = {value}" for name, value in fleet.items())
    path.write_text(f"{before}[fleet]\n{numbers}\n\n[truck]{rest.split('[truck]')[1]}")
    return path


def impulses(fleet: FleetTable, number: int, **changed: float) -> np.ndarray:
    shifts, _exam = Truck(truck_table(TABLE, changed), [], fleet, number, NOMINAL).shifts()
    return np.array([[each.expected_n_s, each.impulse_n_s] for each in shifts])


def test_a_truck_is_drawn_from_seed_and_number_alone() -> None:
    few, many = FleetTable(shifts=30), FleetTable(shifts=30, trucks=500)
    assert np.array_equal(impulses(few, 7), impulses(many, 7))
    assert not np.array_equal(impulses(few, 7), impulses(few, 8))
    assert not np.array_equal(impulses(few, 7), impulses(FleetTable(shifts=30, seed=2), 7))


def test_the_scatter_of_the_friction_is_what_the_speeds_do_not_say() -> None:
    fleet = FleetTable(shifts=2000)
    known = {"cone_unit": 0.0, "cone_wander": 0.0, "cone_drift": 0.0, "drag_n_m": 0.0}
    for sd in (0.0, 0.02, 0.1):
        expected, real = impulses(fleet, 3, cone_shift=sd, **known).T
        assert np.std(np.log(real / expected)) == pytest.approx(sd, rel=0.1, abs=1e-12)
        assert expected.min() >= 14.0
        assert expected.max() <= 250.001


def test_state_is_carried_from_shift_to_shift() -> None:
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=400), 1, NOMINAL).shifts()
    unit_k = np.array([each.settings["sensor.coil_temperature_k"] for each in shifts])
    supply_pa = np.array([each.settings["plant.supply_pressure_pa"] for each in shifts])
    assert np.median(np.abs(np.diff(unit_k))) < 1.0 < np.ptp(unit_k)
    assert 7.5e5 < supply_pa.min() < supply_pa.max() == 9e5
    assert np.mean(np.diff(supply_pa) < 0.0) > 0.6  # the compressor runs now and then


def test_the_closing_of_a_valve_scales_with_its_delay_or_is_constant() -> None:
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=5), 1, NOMINAL).shifts()
    for each in shifts:
        of = each.settings
        assert of["plant.closing_follows_duty"] is True
        settled_s = of["valve.fall_base"] + of["valve.fall_tau"] * math.log(0.98 / 0.34)
        assert settled_s == pytest.approx(of["valve.D_fall"], abs=1e-4)
        assert each.known["controller.strategy_parameters.closing_follows_current"] is True
    constant = truck_table(TABLE, {"closing_follows_current": 0.0})
    shifts, _exam = Truck(constant, POPULATION.factor, FleetTable(shifts=2), 1, NOMINAL).shifts()
    assert "plant.closing_follows_duty" not in shifts[0].settings
    assert shifts[0].known["controller.strategy_parameters.closing_follows_current"] is False


def test_exchanged_valves_open_later_in_every_second_truck_whose_unit_was_off_meanwhile() -> None:
    for number, later_s in ((1, 0.003), (2, 0.0)):
        shifts, _exam = Truck(
            TABLE, POPULATION.factor, FleetTable(shifts=6, exchanged_at=4), number, NOMINAL
        ).shifts()
        agreed = [each.known["controller.strategy_parameters.speeds_agreed"] for each in shifts]
        assert agreed == [True] * 3 + [number == 2] + [True] * 2
        with_s, without_s = (
            [
                each.settings["valve.D_rise"]
                for each in Truck(TABLE, POPULATION.factor, fleet, number, NOMINAL).shifts()[0]
            ]
            for fleet in (FleetTable(shifts=6, exchanged_at=4), FleetTable(shifts=6))
        )
        assert np.subtract(with_s, without_s) == pytest.approx([0.0] * 3 + [later_s] * 3)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cone_shift": -0.1}, "^truck.cone_shift: -0.1 is wrong; expected number >= 0.0$"),
        ({"cone_shift": "much"}, "^truck.cone_shift: 'much' is wrong; expected number$"),
        ({"warm_k": 60.0}, "^truck.warm_k: 60; expected 200 to 450$"),
        ({"direct": 15.0}, "^truck.direct: 15; expected 0 to 1$"),
        ({"warm_up_s": 0.0}, "^truck.warm_up_s: 0; expected 0.001 to 1e"),
        (
            {"supply_low_pa": 9.5e5},
            "^truck.supply_low_pa: 950000; expected at most truck.supply_high_pa, 900000$",
        ),
    ],
)
def test_numbers_of_the_population_are_checked(changed: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        truck_table(TABLE, changed)


def test_a_study_has_a_population_and_needs_strategies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = small(tmp_path)
    whole = path.read_text()
    path.write_text(whole.replace("cone_shift =", "cone_shfit ="))
    assert main(["whatif", str(path)]) == 2
    assert "truck" in capsys.readouterr().err
    path.write_text(whole.split("[[strategy]]")[0])
    assert main(["whatif", str(path)]) == 2
    assert "needs [[strategy]]" in capsys.readouterr().err
    path.write_text(whole.split("[truck]")[0] + '[[strategy]]\nname = "open loop"\n')
    assert load_study(str(path)).study.truck == TABLE
    assert load_study(str(path)).study.factor == POPULATION.factor


def test_relearned_is_when_the_impacts_are_as_before() -> None:
    before, after = np.full(20, 0.5), np.full(30, 0.5)
    assert learned.relearned(np.append(before, after), 0) != 0.0  # NaN: nothing was exchanged
    assert learned.relearned(np.append(before, after), 21) == 0.0
    after[:8] = 0.9
    assert 0.0 < learned.relearned(np.append(before, after), 21) <= 8.0
    after[:] = 0.6
    assert learned.relearned(np.append(before, after), 21) == math.inf


def test_the_memory_is_handed_on_or_erased() -> None:
    """Each shift of the strategy that learns adds to its memory."""
    study = load_study(str(SHIPPED_STUDY))
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=8), 1, NOMINAL).shifts()
    shifts = [each for each in shifts if "plant.charged" not in each.settings][:2]
    own = {"controller.strategy": "learned"}
    kept, erased = (
        [each.memory for each in learned.run_shifts(study.loaded, own, shifts, forgets=forgets)]
        for forgets in (False, True)
    )
    assert len({b"", *kept}) == 3
    assert erased == [b"", b""]
    again = learned.run_shifts(study.loaded, own, shifts[1:], kept[0])
    assert [each.memory for each in again] == kept[1:]


def test_a_unit_that_is_given_the_truth_acts_at_once_and_is_softer() -> None:
    """Than a new unit is in each of these shifts, on average: in some both take the same programme.

    In the first one by 0.16 m/s: its supply is between two tables, and the lower one's programme counts.
    """
    study = load_study(str(SHIPPED_STUDY))
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=40), 2, NOMINAL).shifts()
    large = [
        each for each in shifts if each.impulse_n_s > 80.0 and "plant.charged" not in each.settings
    ][:6]
    own = {"controller.strategy": "learned"}
    plain, fresh, knowing = (
        np.array([
            found.impact_m_s
            for each in large
            for found in learned.run_shifts(study.loaded, settings, [each], knows=knows)
        ])
        for settings, knows in (({}, False), (own, False), (own, True))
    )  # fmt: skip
    assert knowing[0] < plain[0] - 0.1
    assert knowing.mean() < fresh.mean() - 0.02
    assert (fresh <= plain).all()


def test_an_input_speed_that_jumps_before_the_request_makes_the_push_plain() -> None:
    """The jump is over before the push, in which the speeds look as if they were right."""
    study = load_study(str(SHIPPED_STUDY))
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=10), 2, NOMINAL).shifts()
    own = {"controller.strategy": "learned"}
    acted = 0
    for each in (each for each in shifts if "plant.charged" not in each.settings):
        _, memory = learned.truth(each)
        for start_s in (None, 0.08):
            fault = {"speed_fault": [{"kind": "wrong", "start_s": start_s}] if start_s else []}
            hit = [replace(each, settings=each.settings | fault)]
            (found,) = learned.run_shifts(study.loaded, own, hit, memory)
            (plain,) = learned.run_shifts(study.loaded, {}, hit)
            differs = found.impact_m_s != plain.impact_m_s
            assert not (start_s and differs)
            acted += differs
    assert acted > 3


def test_a_programme_that_has_begun_is_carried_out_if_the_position_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Given up with its first filling alone, the push would stop harder than a plain one."""
    study = load_study(str(SHIPPED_STUDY))
    shifts, _exam = Truck(TABLE, POPULATION.factor, FleetTable(shifts=40), 2, NOMINAL).shifts()
    large = [each for each in shifts if each.impulse_n_s > 80.0]
    decided: list[Command] = []
    plain = Learned.decide

    def noting(self: Learned, progress: Progress) -> Command:
        decided.append(plain(self, progress))
        return decided[-1]

    monkeypatch.setattr(Learned, "decide", noting)

    def run(shift: Drawn, lost_s: float | None) -> tuple[list[float | None], Outcome]:
        fault = [{"kind": "off", "start_s": lost_s}] if lost_s is not None else []
        lost = replace(shift, settings=shift.settings | {"sensor_fault": fault})
        _, memory = learned.truth(shift)
        decided.clear()
        own = {"controller.strategy": "learned"}
        (found,) = learned.run_shifts(study.loaded, own, [lost], memory)
        return [each.held for each in decided], found

    runs = ((each, *run(each, None)) for each in large)
    shift, held, whole = next(found for found in runs if gap(found[1]) is not None)
    request_s = float(shift.settings["request"][0]["at_s"])
    begin = next(k for k, each in enumerate(held) if each is not None)
    last = max(k for k, each in enumerate(held) if each is not None)
    # the position counts as lost 50 ms after its last report
    cut, late = run(shift, request_s + 0.01 * gap(held) - 0.05)
    assert cut[: last + 1] == held[: last + 1]
    assert last < len(cut) <= last + 3
    assert late.lost == "was not confirmed"
    assert late.impact_m_s == pytest.approx(whole.impact_m_s, abs=0.02)
    assert len(run(shift, request_s + 0.01 * begin - 0.08)[0]) <= begin


def gap(held: list[float | None]) -> int | None:
    """Return the first step between two fillings, None without one."""
    filled = [k for k, each in enumerate(held) if each is not None]
    return next((k + 1 for k, after in pairwise(filled) if after > k + 1), None)


def test_no_step_of_a_truck_costs_more_than_100_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor what follows a shift more than 300: in shifts of all kinds, not only in the shipped scenario."""
    counts: dict[str, list[int]] = {"command": [], "ended": []}
    for name, found in counts.items():
        plain = getattr(Learned, name)

        def counting(
            self: Learned, *arguments: Any, plain: Any = plain, found: list[int] = found
        ) -> Any:
            answer, counted = operations(plain, self, *arguments)
            found.append(counted)
            return answer

        monkeypatch.setattr(Learned, name, counting)
    study = load_study(str(SHIPPED_STUDY))
    shifts, _exam = Truck(
        TABLE, POPULATION.factor, FleetTable(shifts=16, seed=3), 2, NOMINAL
    ).shifts()
    list(learned.run_shifts(study.loaded, {"controller.strategy": "learned"}, shifts))
    assert 60 < max(counts["command"]) <= 100
    assert 100 < max(counts["ended"]) <= 300


@pytest.mark.slow
def test_strategies_share_trucks_and_workers_do_not_matter(tmp_path: Path) -> None:
    path = small(tmp_path, examined_after=2)
    one, two = tmp_path / "one", tmp_path / "two"
    assert main(["whatif", str(path), "--out", str(one)]) == 0
    assert main(["whatif", str(path), "--out", str(two), "--workers", "2"]) == 0
    assert (one / "results.csv").read_bytes() == (two / "results.csv").read_bytes()
    lines = (one / "results.csv").read_text().splitlines(keepends=True)
    (two / "results.csv").write_text("".join(lines[:3]))
    assert main(["whatif", str(path), "--out", str(two), "--resume"]) == 0
    assert (one / "results.csv").read_bytes() == (two / "results.csv").read_bytes()
    table = read_table(load_study(str(path)), one)
    groups = row_groups(load_study(str(path)), table)
    worst = {label: table.numbers["examined_worst_m_s"][rows] for label, rows in groups.items()}
    assert (worst["oil damper"] < 0.7).all()
    assert (worst["open loop"] > 1.2).all()
    assert np.all(table.numbers["lost_worst_s"][groups["open loop"]] == 0.0)
    assert np.all(table.numbers["harder_worst_m_s"][groups["oil damper"]] < -0.2)
    assert "| oil damper |" in (one / "learned.md").read_text()
