"""Pulse to position, plausibility of samples, the gear windows."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.messages import Gear
from controller.position import (
    Calibration,
    Estimate,
    GearWindows,
    Plausibility,
    Sample,
)
from controller.settings import SensorConfig, WindowConfig
from tests.support.toy_actuator import T_K, exact


class TestCalibration:
    def test_worked_example(self) -> None:
        """1.0 ms at 303.15 K: (0.001/1.012 - 0.0009)/0.022 = 4.00647 mm."""
        got_m = Calibration(SensorConfig()).position_m(0.001, 303.15)
        assert got_m == pytest.approx(4.00647e-3, abs=1e-8)

    def test_every_setting_counts(self) -> None:
        sensor = SensorConfig(
            t_mid_s=0.002, slope_s_per_m=0.1, temp_coeff_per_k=0.002, t_ref_k=300.0
        )
        got_m = Calibration(sensor).position_m(0.0033, 350.0)
        assert got_m == pytest.approx((0.0033 / 1.1 - 0.002) / 0.1, abs=1e-15)

    def test_uncompensated_temperature_would_be_millimetres(self) -> None:
        """Why it is compensated: 40 K are 4.8 % of the pulse, about 2 mm."""
        warm = exact(0.0, 0, T_K + 40.0)
        wrong_m = Calibration(SensorConfig(temp_coeff_per_k=0.0)).position_m(warm.pulse_s, T_K)
        assert wrong_m == pytest.approx(1.96e-3, abs=1e-5)

    def test_still_is_two_ticks(self) -> None:
        sensor = SensorConfig(still_ticks=2, timer_resolution_s=3e-6, slope_s_per_m=0.03)
        assert Calibration(sensor).still_m == pytest.approx(2e-4)


class TestPlausibility:
    def make(self, slack_m: float = 0.001, **sensor: Any) -> Plausibility:
        return Plausibility(SensorConfig(**sensor), 0.01285, slack_m)

    def test_range(self) -> None:
        p = self.make(overtravel_m=0.002, temperature_min_k=250.0, temperature_max_k=400.0)
        assert p.in_range(0.01484, 250.0)
        assert p.in_range(-0.01484, 400.0)
        assert not p.in_range(0.01486, 300.0)
        assert not p.in_range(-0.01486, 300.0)
        assert not p.in_range(0.0, 249.9)
        assert not p.in_range(0.0, 400.1)
        assert not p.in_range(math.nan, 300.0)
        assert not p.in_range(0.0, math.nan)

    def test_range_ends_belong_to_it(self) -> None:
        p = Plausibility(
            SensorConfig(overtravel_m=0.0, temperature_min_k=250.0, temperature_max_k=400.0),
            0.5,
            0.0,
        )
        assert p.in_range(0.5, 250.0)
        assert p.in_range(-0.5, 400.0)

    def test_reach(self) -> None:
        def p() -> Plausibility:
            return self.make(max_speed_m_s=1.0, period_s=0.01, travel_limit_m=1.0)

        assert p().follows(0.0109, 1)
        assert p().follows(-0.0109, 1)
        assert not p().follows(0.0111, 1)
        assert not p().follows(-0.0111, 1)
        assert p().follows(0.0209, 2)
        assert not p().follows(0.0211, 2)

    def test_reach_and_travel_limits_are_allowed(self) -> None:
        assert Plausibility(
            SensorConfig(max_speed_m_s=0.5, period_s=0.1, travel_limit_m=0.05), 0.01, 0.0
        ).follows(0.05, 1)

    def test_travel_adds_up_whatever_its_sign_and_leaks(self) -> None:
        p = self.make(travel_limit_m=0.045, travel_leak_m_s=0.1)  # 1 mm a sample
        assert p.follows(0.02, 1)
        assert p.follows(-0.02, 1)  # 39 mm
        assert not p.follows(0.0071, 1)  # 45.1 mm
        assert p.follows(0.0, 2)  # 43.1 mm
        assert p.follows(0.0, 100)  # forgotten, never below zero
        assert p.follows(0.02, 1)
        assert p.follows(-0.02, 1)
        assert p.follows(0.0059, 1)

    def test_travel_is_bounded_so_that_it_ends(self) -> None:
        p = self.make(travel_limit_m=0.02, travel_leak_m_s=0.1)
        for _ in range(50):
            assert not p.follows(0.03, 1)
        # saturates at 20 + 12.85 mm, so 13 samples of 1 mm bring it below 20 mm
        verdicts = [p.follows(0.0, 1) for _ in range(14)]
        assert verdicts == [False] * 12 + [True] * 2

    def test_restart_forgets_the_travel(self) -> None:
        p = self.make(travel_limit_m=0.02)
        assert p.follows(0.02, 1)
        p.restart()
        assert p.follows(0.02, 1)
        assert not p.follows(0.02, 1)

    def test_level(self) -> None:
        p = self.make(bad_limit=6)
        for good in (False, False, True):
            p.count(good)  # 4, then 3
            assert not p.implausible
        p.count(False)  # 5
        assert not p.implausible
        p.count(False)  # 6, not 7
        assert p.implausible
        for _ in range(5):
            p.count(True)
            assert p.implausible
        p.count(True)
        assert not p.implausible

    def test_level_never_below_zero(self) -> None:
        p = self.make(bad_limit=2)
        for _ in range(10):
            p.count(True)
        p.count(False)
        assert p.implausible


class TestWindows:
    def estimate(self, *samples: tuple[float, float], valid: bool = True) -> Estimate:
        in_windows = tuple(Sample(raw_m, position_m, 0.0) for raw_m, position_m in samples)
        return Estimate(valid, 0.0, 0.0, 0.0, in_windows)

    def make(self) -> GearWindows:
        return GearWindows(
            WindowConfig(stroke_m=0.012, neutral_tolerance_m=0.002, gear_tolerance_m=0.001)
        )

    @pytest.mark.parametrize(
        ("position_m", "gear"),
        [
            (0.0, Gear.NEUTRAL),
            (0.002, Gear.NEUTRAL),
            (-0.002, Gear.NEUTRAL),
            (0.0020001, Gear.UNKNOWN),
            (-0.0020001, Gear.UNKNOWN),
            (0.0109999, Gear.UNKNOWN),
            (0.011, Gear.BACKWARD),
            (0.020, Gear.BACKWARD),
            (-0.0109999, Gear.UNKNOWN),
            (-0.011, Gear.FORWARD),
            (-0.020, Gear.FORWARD),
        ],
    )
    def test_where(self, position_m: float, gear: Gear) -> None:
        assert self.make().gear_at(position_m) is gear

    def test_runs(self) -> None:
        windows = self.make()
        assert (windows.gear, windows.run) == (Gear.UNKNOWN, 0)
        windows.update(self.estimate((0.0, 0.0)))
        assert (windows.gear, windows.run) == (Gear.NEUTRAL, 1)
        windows.update(self.estimate())
        assert (windows.gear, windows.run) == (Gear.NEUTRAL, 1)
        windows.update(self.estimate((0.0, 0.0), (0.001, 0.001)))
        assert (windows.gear, windows.run) == (Gear.NEUTRAL, 3)
        windows.update(self.estimate((0.0, 0.0), (0.012, 0.012)))
        assert (windows.gear, windows.run) == (Gear.BACKWARD, 1)

    @pytest.mark.parametrize("sample", [(0.010, 0.012), (0.012, 0.010), (0.012, 0.0)])
    def test_both_measured_and_filtered_must_be_inside(self, sample: tuple[float, float]) -> None:
        windows = self.make()
        windows.update(self.estimate((0.012, 0.012), (0.012, 0.012), sample))
        assert (windows.gear, windows.run) == (Gear.UNKNOWN, 1)

    def test_invalid_belongs_to_no_gear(self) -> None:
        windows = self.make()
        windows.update(self.estimate((0.0, 0.0), (0.0, 0.0)))
        windows.update(self.estimate((0.0, 0.0), valid=False))
        assert (windows.gear, windows.run) == (Gear.UNKNOWN, 0)
        windows.update(self.estimate((0.0, 0.0)))
        assert windows.run == 1


@given(x_m=st.floats(-0.016, 0.016), temperature_k=st.floats(233.15, 423.15))
def test_inverts_the_pulse_law(x_m: float, temperature_k: float) -> None:
    pulse = exact(x_m, 0, temperature_k)
    got_m = Calibration(SensorConfig()).position_m(pulse.pulse_s, temperature_k)
    assert got_m == pytest.approx(x_m, abs=1e-12)


@given(st.lists(st.booleans(), max_size=60))
def test_level_is_a_leaky_count(verdicts: list[bool]) -> None:
    p = Plausibility(SensorConfig(bad_limit=6), 0.01285, 0.001)
    level, tripped = 0, False
    for good in verdicts:
        p.count(good)
        level = max(level - 1, 0) if good else min(level + 2, 6)
        tripped = level == 6 or (tripped and level > 0)
        assert p.implausible == tripped
