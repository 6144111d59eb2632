"""Driveline: engine synchronisation, impulse of the cone, speeds that agree at its end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from plant.devices.driveline import (
    BACKWARD,
    FORWARD,
    NO_GEAR,
    Driveline,
    DrivelineConfig,
    ToothedWheel,
)

MS = 1_000_000
X_BLOCK = 0.006
STROKE = 0.01285


def steps(driveline: Driveline, instants_ms: range, position_m: float) -> list[float | None]:
    return [driveline.advance(t * MS, position_m, 0.0, NO_GEAR) for t in instants_ms]


def test_in_gear_the_shafts_agree() -> None:
    driveline = Driveline(DrivelineConfig(residual_rad_s=9.0), X_BLOCK, STROKE)
    assert steps(driveline, range(0, 100, 10), STROKE) == [None] * 10
    assert driveline.input_rad_s == driveline.output_rad_s == 80.0


def test_engine_ramps_from_the_gear_step_to_the_residual() -> None:
    config = DrivelineConfig(
        gear_step_rad_s=30.0, engine_ramp_rad_s2=150.0, engine_delay_s=0.02, residual_rad_s=6.0
    )
    driveline = Driveline(config, X_BLOCK, STROKE)
    differences = {}
    for t in range(0, 401, 10):
        driveline.advance(t * MS, STROKE if t < 50 else 0.0, 0.0, NO_GEAR)
        differences[t] = driveline.input_rad_s - driveline.output_rad_s
    assert differences[40] == 0.0
    assert differences[50] == differences[60] == differences[70] == 30.0
    assert differences[130] == pytest.approx(30.0 - 150.0 * 0.06)
    assert differences[230] == pytest.approx(6.0, abs=1e-9)
    assert differences[400] == pytest.approx(6.0, abs=1e-12)


def test_ramp_does_not_depend_on_the_raster_of_calls() -> None:
    results = []
    for raster in (range(0, 201, 100), range(0, 201, 2)):
        driveline = Driveline(DrivelineConfig(), X_BLOCK, STROKE)
        driveline.advance(0, 0.0, 0.0, NO_GEAR)
        for t in raster:
            driveline.advance(t * MS, 0.0, 0.0, NO_GEAR)
        results.append(driveline.input_rad_s)
    assert results[0] == pytest.approx(results[1], rel=1e-12)
    assert results[0] == pytest.approx(80.0 + 30.0 - 150.0 * 0.18)


def test_impulse_follows_from_speed_difference_inertia_and_cone() -> None:
    config = DrivelineConfig(residual_rad_s=-9.0, inertia_kg_m2=0.3, cone_gain_m=0.1)
    driveline = Driveline(config, X_BLOCK, 0.0)
    assert driveline.advance(0, 0.0, 0.0, BACKWARD) == pytest.approx(27.0)
    assert driveline.input_rad_s == 71.0
    assert driveline.advance(10 * MS, 0.0, 0.0, BACKWARD) is None  # armed already


@settings(deadline=None)
@given(st.floats(0.5, 40.0), st.lists(st.floats(0.0, 1.0), max_size=6))
def test_speeds_converge_in_proportion_to_the_spent_impulse(
    residual: float, shares: list[float]
) -> None:
    driveline = Driveline(DrivelineConfig(residual_rad_s=residual), X_BLOCK, 0.0)
    impulse = driveline.advance(0, 0.0, 0.0, FORWARD)
    assert impulse is not None
    for i, share in enumerate(sorted(shares)):
        assert driveline.advance((i + 1) * MS, -X_BLOCK, share * impulse, FORWARD) is None
        difference = driveline.input_rad_s - driveline.output_rad_s
        assert difference == pytest.approx(residual * (1.0 - share), abs=1e-9)
    driveline.advance(50 * MS, -X_BLOCK, impulse, FORWARD)
    assert driveline.input_rad_s == driveline.output_rad_s
    driveline.advance(60 * MS, -0.007, impulse, FORWARD)
    assert driveline.is_engaged and driveline.input_rad_s == driveline.output_rad_s


def test_stated_impulse_of_each_gear_and_the_difference_it_implies() -> None:
    config = DrivelineConfig(
        impulse_backward_n_s=18.0, impulse_forward_n_s=36.0, engine_ramp_rad_s2=1000.0
    )
    driveline = Driveline(config, X_BLOCK, 0.0)
    assert driveline.advance(0, 0.0, 0.0, NO_GEAR) == 36.0
    assert driveline.advance(10 * MS, 0.0, 0.0, BACKWARD) == 18.0
    assert driveline.input_rad_s - 80.0 == pytest.approx(18.0 * 0.09 / 0.25)
    driveline.advance(20 * MS, 0.0, 0.0, BACKWARD)
    driveline.advance(30 * MS, X_BLOCK, 9.0, BACKWARD)
    assert driveline.input_rad_s - 80.0 == pytest.approx(9.0 * 0.09 / 0.25)
    one_sided = Driveline(DrivelineConfig(impulse_backward_n_s=18.0), X_BLOCK, 0.0)
    assert one_sided.required_impulse_n_s(BACKWARD) == 18.0
    assert one_sided.residual_rad_s(FORWARD) == 0.0
    negative = DrivelineConfig(impulse_forward_n_s=25.0, residual_rad_s=-1.0)
    assert Driveline(negative, X_BLOCK, 0.0).residual_rad_s(FORWARD) == pytest.approx(-9.0)


def test_a_stay_pushed_back_from_the_block_needs_only_the_rest() -> None:
    config = DrivelineConfig(residual_rad_s=9.0, engine_delay_s=0.0, engine_ramp_rad_s2=1e-6)
    driveline = Driveline(config, X_BLOCK, 0.0)
    assert driveline.advance(0, 0.0, 0.0, BACKWARD) == pytest.approx(25.0)
    driveline.advance(10 * MS, X_BLOCK, 0.6 * 25.0, BACKWARD)
    assert driveline.advance(20 * MS, 0.0, 0.6 * 25.0, BACKWARD) == pytest.approx(10.0)
    assert driveline.input_rad_s - 80.0 == pytest.approx(3.6)


def test_what_one_engagement_spent_does_not_count_for_the_next() -> None:
    config = DrivelineConfig(residual_rad_s=9.0, engine_delay_s=0.0, engine_ramp_rad_s2=100.0)
    driveline = Driveline(config, X_BLOCK, 0.0)
    assert driveline.advance(0, 0.0, 0.0, BACKWARD) == pytest.approx(25.0)
    driveline.advance(10 * MS, STROKE, 25.0, BACKWARD)
    driveline.advance(20 * MS, 0.0055, 25.0, NO_GEAR)
    driveline.advance(30 * MS, 0.0040, 25.0, NO_GEAR)
    assert driveline.input_rad_s - 80.0 == 30.0
    assert driveline.advance(40 * MS, 0.0, 25.0, NO_GEAR) == pytest.approx(29.0 * 0.25 / 0.09)
    assert driveline.input_rad_s - 80.0 == pytest.approx(29.0)


def test_impulse_is_left_alone_between_neutral_and_the_block() -> None:
    driveline = Driveline(DrivelineConfig(residual_rad_s=9.0), X_BLOCK, 0.0)
    driveline.advance(0, 0.0, 0.0, BACKWARD)
    assert driveline.advance(10 * MS, 0.0045, 0.0, FORWARD) is None
    assert driveline.input_rad_s == 89.0


def test_a_rig_without_synchronizer_blocks_only_when_told_to() -> None:
    free = Driveline(DrivelineConfig(residual_rad_s=9.0), X_BLOCK, 0.0, has_synchronizer=False)
    assert free.advance(0, 0.0, 0.0, BACKWARD) is None
    stated = DrivelineConfig(impulse_backward_n_s=5.0)
    blocked = Driveline(stated, X_BLOCK, 0.0, has_synchronizer=False)
    assert blocked.advance(0, 0.0, 0.0, BACKWARD) == 5.0


def test_impossible_values_are_refused() -> None:
    with pytest.raises(InputError, match=r"synchronizer.x_block: "):
        Driveline(DrivelineConfig(), 0.0, 0.0)
    driveline = Driveline(DrivelineConfig(), X_BLOCK, 0.0)
    driveline.advance(10, 0.0, 0.0, NO_GEAR)
    with pytest.raises(ValueError, match="asked for 9 ns"):
        driveline.advance(9, 0.0, 0.0, NO_GEAR)


PERIOD_NS = 10_000_000


def readings(
    speed_rad_s: float, teeth: int, timer_s: float = 1e-6, noise: float = 0.0
) -> list[float]:
    wheel = ToothedWheel(teeth, timer_s, noise, np.random.default_rng(1))
    return [wheel.measure(k * PERIOD_NS, speed_rad_s) for k in range(1, 200)][10:]


def test_error_is_that_of_two_ticks_of_the_timer() -> None:
    for speed, timer_s in ((98.0, 1e-6), (98.0, 1e-4), (20.0, 1e-4)):
        measured = readings(speed, 60, timer_s)
        between_s = 0.010 - 2.0 * np.pi / 60 / speed  # at least, from edge to edge
        assert max(abs(r - speed) for r in measured) <= 1.01 * speed * timer_s / between_s
        assert max(abs(r - speed) for r in measured) > 0.0


def test_slow_shaft_holds_its_speed_between_teeth() -> None:
    measured = readings(3.0, 60)  # a tooth every 35 ms
    assert measured == pytest.approx([3.0] * len(measured), rel=1e-3)


def test_shaft_at_rest_reads_the_last_speed_and_zero_before_the_first_teeth() -> None:
    wheel = ToothedWheel(60, 1e-6, 0.0, np.random.default_rng(1))
    assert [wheel.measure(k * PERIOD_NS, 0.0) for k in range(3)] == [0.0, 0.0, 0.0]


def test_noise_has_its_standard_deviation_with_and_without_teeth() -> None:
    for teeth in (0, 60):
        measured = readings(98.0, teeth, noise=0.5)
        assert np.std(measured) == pytest.approx(0.5, rel=0.2)
        assert np.mean(measured) == pytest.approx(98.0, abs=0.15)
