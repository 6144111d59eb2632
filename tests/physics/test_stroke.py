"""One stroke under stated conditions: what the thesis says of its course."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.errors import InputError
from plant.kernel.layout import LengthState
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import NOMINAL

TIME_S = np.arange(0, 3001) * 1e-4
FIXED = StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98), (0.25, "1", 0.0)))


def test_fixed_piston_moves_for_15_ms_and_fills_in_about_200_ms() -> None:
    stroke = simulate(NOMINAL, FIXED, TIME_S)
    assert stroke.impact is not None
    started = next(e.time_s for e in stroke.events if e.name == "breakaway")
    assert stroke.impact.time_s - started == pytest.approx(0.015, abs=0.001)
    full = TIME_S[np.argmax(stroke.pressure_pa("1") > 0.99 * 9e5)]
    assert 0.17 < full - 0.018 < 0.23
    assert stroke.position_m[-1] == pytest.approx(0.01285, abs=1e-9)


def test_stroke_starts_from_rest_with_the_stated_pressures() -> None:
    stroke = simulate(
        NOMINAL, StrokeConditions("N-B", 7e5, (), 99000.0, charged_before=("N",)), TIME_S[:10]
    )
    assert stroke.pressure_pa("N")[0] == 7e5
    assert stroke.pressure_pa("B")[0] == stroke.pressure_pa("F")[0] == 99000.0
    assert stroke.duty[0].tolist() == [0.0, 0.98, 0.0]


def test_duty_is_that_of_the_last_command() -> None:
    duty = simulate(NOMINAL, FIXED, TIME_S, internal=False).duty
    assert duty[99, 0] == 0.0 and duty[100, 0] == 0.98
    assert duty[2499, 0] == 0.98 and duty[2500, 0] == 0.0
    assert not duty[:, 1].any()


def test_reported_position_lags_the_true_one() -> None:
    stroke = simulate(NOMINAL, FIXED, TIME_S)
    truth, reported = stroke.position_m, stroke.internal_m
    for share in (0.1, 0.9):
        level = share * 0.01285
        lag = TIME_S[np.argmax(reported > level)] - TIME_S[np.argmax(truth > level)]
        assert 0.02 < lag < 0.05


def test_walk_of_the_piston_is_not_observable() -> None:
    conditions = StrokeConditions("N-B", 9e5, ((0.01, "B", 0.98),))
    stroke = simulate(NOMINAL, conditions, TIME_S)
    walk = next(e.time_s for e in stroke.events if e.name == "collar 1 contact")
    still = walk > TIME_S
    assert np.abs(stroke.position_m[still]).max() < 1e-12
    assert np.ptp(stroke.states[still, LengthState.x_1]) > 0.0129 - 0.0005
    assert np.ptp(stroke.pressure_pa("B")[still]) > 3e4


@pytest.mark.parametrize("model", ["compressible", "incompressible"])
def test_oil_pressure_by_the_model_that_ran(model: str) -> None:
    conditions = replace(FIXED, load="damper", damper_model=model)
    stroke = simulate(NOMINAL, conditions, TIME_S)
    oil = stroke.pressure_pa("oil2")
    assert oil[0] == 101325.0
    assert 5e5 < oil.max() < 5e6
    assert oil.min() >= 101325.0 - 1e-6
    assert stroke.impact is not None and stroke.impact.speed_m_s < 0.3


def test_compressible_oil_has_more_pressure_maxima() -> None:
    counts = []
    for model in ("incompressible", "compressible"):
        conditions = replace(FIXED, load="damper", damper_model=model)
        oil = simulate(NOMINAL, conditions, TIME_S).pressure_pa("oil2")
        middle = oil[1:-1]
        peaks = (middle > oil[:-2]) & (middle > oil[2:]) & (middle > 3e5)
        counts.append(int(peaks.sum()))
    assert counts[1] > counts[0]


def test_spring_holds_the_fixed_piston_back() -> None:
    spring = replace(FIXED, load="spring", spring_n_per_m=25000.0, start_offset_m=0.00425827892)
    free = replace(spring, load="none")
    speeds = []
    for conditions in (spring, free):
        stroke = simulate(NOMINAL, conditions, TIME_S)
        assert stroke.position_m[0] == 0.00425827892
        assert stroke.impact is not None
        speeds.append(stroke.impact.speed_m_s)
    assert speeds[0] < 0.8 * speeds[1]
    spring = replace(spring, spring_n_per_m=3e5)
    assert simulate(NOMINAL, spring, TIME_S).impact is None


@pytest.mark.parametrize("offset", [-0.001, 0.0135])
def test_start_outside_the_stroke_is_refused(offset: float) -> None:
    with pytest.raises(InputError, match="start_offset_m"):
        simulate(NOMINAL, replace(FIXED, start_offset_m=offset), TIME_S)


@pytest.mark.parametrize(
    ("offset", "stop"), [(-1e-4, 0.0), (0.0129, NOMINAL.value("fixed.stroke"))]
)
def test_start_measured_a_hair_outside_the_stroke_is_on_the_stop(
    offset: float, stop: float
) -> None:
    stroke = simulate(NOMINAL, replace(FIXED, start_offset_m=offset), TIME_S)
    assert stroke.position_m[0] == stop


@pytest.mark.parametrize("kind", ["N-B", "B-N", "N-F", "F-N"])
def test_three_times_the_dynamic_friction_is_slower(kind: str) -> None:
    names = ("F_rf_s", "F_rf_p", "beta_s", "beta_p")
    heavy = NOMINAL.override(
        {f"friction_length.{n}": 3.0 * NOMINAL.value(f"friction_length.{n}") for n in names}
    )
    conditions = StrokeConditions(kind, 9e5, ((0.01, kind[-1], 0.98),))
    plain = simulate(NOMINAL, conditions, TIME_S, internal=False).impact
    heavy_stroke = simulate(heavy, conditions, TIME_S, internal=False)
    slow = heavy_stroke.impact
    assert plain is not None and slow is not None
    assert slow.time_s > plain.time_s + 1e-3
    assert slow.speed_m_s < plain.speed_m_s
    assert len(heavy_stroke.events) < 20
