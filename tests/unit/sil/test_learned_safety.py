"""The count of shifts beyond the limits: what it compares with, and that it can find one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sil.simulation.in_memory import run_in_memory
from sil.studies.fleet import FleetTable, Truck
from sil.studies.kinds.learned import Outcome, nominal, outcome, run_shifts
from sil.studies.load_study import load_study
from sil.studies.study import texts_of
from tests.bench import _learned_safety as safety

STUDY = load_study("learned")
OWN = {"controller.strategy": "learned"}


def drawn(shifts: int) -> list[safety.Drawn]:
    assert STUDY.study.truck is not None
    fleet = FleetTable(shifts=shifts, seed=3)
    return Truck(STUDY.study.truck, STUDY.study.factor, fleet, 2, nominal(STUDY, {})).shifts()[0]


def test_the_plant_alone_under_a_plain_push_does_what_the_open_loop_does() -> None:
    """Also from a run in which neutral was filled, and after a blow on neutral."""
    acted, blown, memory = 0, 0, b""
    for shift in drawn(16):
        loaded = STUDY.loaded(texts_of({**shift.settings, **shift.known, **OWN}))
        run = run_in_memory(loaded, memory)
        memory = run.memory
        (open_loop,) = run_shifts(STUDY.loaded, {}, [shift])
        impact_m_s, time_s = safety.plain_push(run, loaded.parameters, shift.impulse_n_s)
        assert impact_m_s == pytest.approx(open_loop.impact_m_s, abs=safety.CERTAIN)
        assert time_s == pytest.approx(open_loop.time_s, abs=0.1 * safety.CERTAIN)
        blown += "plant.charged" in shift.settings
        acted += outcome(run).time_s > open_loop.time_s + 0.001
    assert acted > 2
    assert blown > 0


@pytest.mark.parametrize(
    ("impact_m_s", "time_s", "within", "what"),
    [
        (1.04, 0.15, True, ""),
        (1.06, 0.15, False, "0.060 m/s harder"),
        (0.6, 0.179, True, ""),
        (0.6, 0.181, False, "31 ms longer"),
        (1.049999, 0.15, False, ""),
    ],
)
def test_a_shift_is_beyond_the_limits_by_its_impact_or_its_time(
    impact_m_s: float, time_s: float, within: bool, what: str
) -> None:
    found, plain = Outcome(impact_m_s, 1.0, time_s, "", b""), Outcome(1.0, 1.0, 0.15, "", b"")
    assert safety.is_within(found, plain.impact_m_s, plain.time_s) == within
    assert safety.broken(found, plain, plain.impact_m_s) == what


def test_a_programme_that_stops_the_stay_at_the_teeth_is_found() -> None:
    (shift,) = [each for each in drawn(16) if 40.0 < each.impulse_n_s < 60.0][:1]
    harsh = {
        "controller.strategy": "fixed_programme",
        "controller.strategy_parameters.rest_begin_s": 0.05,
        "controller.strategy_parameters.rest_s": 0.12,
    }
    loaded = STUDY.loaded(texts_of({**shift.settings, **harsh}))
    found = outcome(run_in_memory(loaded, b""))
    (open_loop,) = run_shifts(STUDY.loaded, {}, [shift])
    assert safety.broken(found, open_loop, open_loop.impact_m_s)


def test_speeds_that_were_wrong_before_the_first_reports_were_so_in_the_last_gear() -> None:
    rng = np.random.default_rng(2)
    key = "controller.strategy_parameters.speeds_agreed"
    shifts = [replace(each, known=dict(each.known)) for each in drawn(16)] * 30
    found = list(safety.faulty("speeds", shifts, rng))
    failing = [each for each in found if "speed_fault" in each.settings]
    early = [each for each in failing if each.settings["speed_fault"][0]["start_s"] < 0.02]
    assert 0 < len(early) < 0.2 * len(failing)
    assert all(each.known[key] is (each not in early) for each in found)
