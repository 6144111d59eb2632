"""Pulse to position, plausibility of samples, the gear windows, and the estimator with its filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from can_dbc.messages import Gear, PositionPulse
from controller.config import FirmwareConfig
from controller.position import (
    Calibration,
    Estimate,
    GearWindows,
    Plausibility,
    PositionEstimator,
    Sample,
)
from controller.settings import E2eConfig, FilterConfig, SensorConfig, WindowConfig
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

    def test_still_is_two_ticks(self) -> None:
        sensor = SensorConfig(still_ticks=2, timer_resolution_s=3e-6, slope_s_per_m=0.03)
        assert Calibration(sensor).still_m == pytest.approx(2e-4)


class TestPlausibility:
    def make(self, slack_m: float = 0.001, **sensor: Any) -> Plausibility:
        return Plausibility(SensorConfig(**sensor), 0.01285, slack_m)

    def test_range(self) -> None:
        p = self.make(overtravel_m=0.002, temperature_min_k=250.0, temperature_max_k=400.0)
        assert p.in_range(0.01484, 250.0) and p.in_range(-0.01484, 400.0)
        assert not p.in_range(0.01486, 300.0) and not p.in_range(-0.01486, 300.0)
        assert not p.in_range(0.0, 249.9) and not p.in_range(0.0, 400.1)
        assert not p.in_range(math.nan, 300.0) and not p.in_range(0.0, math.nan)

    def test_range_ends_belong_to_it(self) -> None:
        p = Plausibility(
            SensorConfig(overtravel_m=0.0, temperature_min_k=250.0, temperature_max_k=400.0),
            0.5,
            0.0,
        )
        assert p.in_range(0.5, 250.0) and p.in_range(-0.5, 400.0)

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
        assert [p.follows(0.0, 1) for _ in range(14)] == [False] * 12 + [True] * 2

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
            (0.0, Gear.NEUTRAL),        (0.002, Gear.NEUTRAL),      (-0.002, Gear.NEUTRAL),
            (0.0020001, Gear.UNKNOWN),  (-0.0020001, Gear.UNKNOWN), (0.0109999, Gear.UNKNOWN),
            (0.011, Gear.BACKWARD),     (0.020, Gear.BACKWARD),     (-0.0109999, Gear.UNKNOWN),
            (-0.011, Gear.FORWARD),     (-0.020, Gear.FORWARD),
        ],
    )  # fmt: skip
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


def pulses(positions_m: Sequence[float], start: int = 0) -> list[PositionPulse]:
    return [exact(x, start + i) for i, x in enumerate(positions_m)]


def unfiltered(**sensor: Any) -> FirmwareConfig:
    return FirmwareConfig(filter=FilterConfig(enabled=False), sensor=SensorConfig(**sensor))


def feed(estimator: PositionEstimator, positions_m: Sequence[float], start: int = 0) -> Estimate:
    for pulse in pulses(positions_m, start):
        estimate = estimator.update([pulse], False)
    return estimate


class TestEstimator:
    def test_nothing_yet(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        assert estimator.update([], False) == Estimate(False, 0.0, 0.0, 0.0, ())
        assert not estimator.implausible and not estimator.stuck
        assert not estimator.moved

    def test_starts_at_rest_at_the_first_sample(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        first = estimator.update([exact(0.01, 200)], False)
        x_m = pytest.approx(0.01, abs=1e-12)
        assert first == Estimate(True, x_m, x_m, 0.0, (Sample(x_m, x_m, 0.0),))
        second = estimator.update([exact(0.01, 201)], False)
        assert second.position_m == pytest.approx(0.01, abs=1e-12)
        assert second.velocity_m_s == pytest.approx(0.0, abs=1e-9)

    def test_between_samples_it_holds(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        feed(estimator, [0.0, 0.002])
        unchanged = estimator.update([], False)
        assert unchanged.samples == () and unchanged.valid
        assert unchanged.raw_m == pytest.approx(0.002)
        assert 0.0 < unchanged.position_m < 0.002
        assert unchanged.velocity_m_s == pytest.approx(unchanged.position_m / 0.01)

    @pytest.mark.parametrize("per_step", [1, 4])
    def test_same_as_scipy_whether_one_or_four_samples_a_step(self, per_step: int) -> None:
        config = FirmwareConfig(sensor=SensorConfig(period_s=0.0025))
        steps_m = 0.0003 * np.random.default_rng(1).standard_normal(200) * np.hanning(200)
        positions_m = np.clip(np.cumsum(steps_m), -0.012, 0.012)
        positions_m[0] = 0.0
        reference = signal.sosfilt(signal.butter(6, 22.0, fs=400.0, output="sos"), positions_m)
        estimator = PositionEstimator(config)
        got: list[Sample] = []
        train = pulses(positions_m.tolist())
        for start in range(0, 200, per_step):
            estimate = estimator.update(train[start : start + per_step], False)
            assert len(estimate.samples) == per_step
            last = estimate.samples[-1]
            assert (estimate.raw_m, estimate.position_m, estimate.velocity_m_s) == last
            got += estimate.samples
        assert np.max(np.abs(reference - [s.position_m for s in got])) < 1e-12
        assert np.max(np.abs(positions_m - [s.raw_m for s in got])) < 1e-12
        slope = np.diff(reference, prepend=0.0) / 0.0025
        assert np.max(np.abs(slope - [s.velocity_m_s for s in got])) < 1e-8

    def test_without_filter_the_estimate_is_the_sample(self) -> None:
        estimate = feed(PositionEstimator(unfiltered()), [0.0, 0.001, 0.004])
        assert estimate.position_m == estimate.raw_m == pytest.approx(0.004)
        assert estimate.velocity_m_s == pytest.approx(0.3)

    def test_missing_samples_are_interpolated(self) -> None:
        """Two of three lost on a ramp: the filter does not notice."""
        whole, torn = PositionEstimator(FirmwareConfig()), PositionEstimator(FirmwareConfig())
        ramp = [exact(0.0005 * i, i) for i in range(20)]
        for i, pulse in enumerate(ramp):
            full = whole.update([pulse], False)
            if i % 3 == 0:
                part = torn.update([pulse], False)
                assert part.position_m == pytest.approx(full.position_m, abs=1e-12)
                assert part.velocity_m_s == pytest.approx(full.velocity_m_s, abs=1e-9)
                assert len(part.samples) == 1

    @pytest.mark.parametrize(("gap", "afresh"), [(5, False), (6, True)])
    def test_after_a_longer_gap_it_starts_afresh(self, gap: int, afresh: bool) -> None:
        estimator = PositionEstimator(FirmwareConfig(e2e=E2eConfig(position_timeout_s=0.05)))
        feed(estimator, [0.0, 0.0])
        estimate = estimator.update([exact(0.006, 1 + gap)], False)
        assert (estimate.position_m == estimate.raw_m) == afresh

    def test_longest_gap_is_64_samples_however_long_the_timeout(self) -> None:
        config = FirmwareConfig(e2e=E2eConfig(position_timeout_s=10.0))
        for gap, afresh in ((64, False), (65, True)):
            estimator = PositionEstimator(config)
            feed(estimator, [0.0, 0.0])
            # the filter has come to rest at the new place in any case; the velocity tells
            estimate = estimator.update([exact(0.006, 1 + gap)], False)
            assert (estimate.velocity_m_s == 0.0) == afresh

    def test_index_wraps(self) -> None:
        """As if the number had no end: same filter state, same reach across the wrap."""
        wraps, plain = PositionEstimator(FirmwareConfig()), PositionEstimator(FirmwareConfig())
        for i in range(20):
            a = wraps.update([exact(0.0005 * i, 250 + i)], False)
            assert a == plain.update([exact(0.0005 * i, i)], False)
        tight = PositionEstimator(unfiltered(max_speed_m_s=1.0))
        feed(tight, [0.0], 255)
        assert tight.update([exact(0.0105, 256)], False).samples == ()

    def test_the_same_sample_again_is_ignored(self) -> None:
        estimator = PositionEstimator(unfiltered())
        feed(estimator, [0.0, 0.001])
        again = estimator.update([exact(0.002, 1), exact(0.003, 1)], False)
        assert again.samples == () and again.raw_m == pytest.approx(0.001)
        assert not estimator.implausible

    def test_work_per_step_is_bounded_to_the_newest(self) -> None:
        estimator = PositionEstimator(unfiltered())  # 10 ms step, 10 ms sensor: 4 at most
        train = pulses([0.0001 * i for i in range(30)])
        estimator.update(train[:1], False)
        estimate = estimator.update(train[1:], False)
        assert [round(s.raw_m, 7) for s in estimate.samples] == [0.0026, 0.0027, 0.0028, 0.0029]
        fast = PositionEstimator(unfiltered(period_s=0.0025))
        assert len(fast.update(train, False).samples) == 7

    def test_a_lost_channel_voids_it_and_it_starts_afresh(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        feed(estimator, [0.0, 0.006])
        lost = estimator.update([exact(0.001, 2)], True)
        assert not lost.valid and lost.samples == ()
        assert lost.raw_m == pytest.approx(0.006)  # stands still
        assert not estimator.update([], False).valid
        back = estimator.update([exact(-0.012, 3)], False)
        assert back.valid
        assert back.position_m == back.raw_m == pytest.approx(-0.012)
        assert back.velocity_m_s == 0.0

    def test_loss_forgets_old_travel_and_the_last_place(self) -> None:
        estimator = PositionEstimator(unfiltered(max_speed_m_s=0.2))
        feed(estimator, [0.0])
        estimator.update([], True)
        assert estimator.update([exact(0.0128, 1)], False).valid
        assert not estimator.implausible
        assert estimator.update([exact(0.0128, 2)], False).samples  # nor was it counted as bad

    def test_one_spike_is_left_out(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        clean = PositionEstimator(FirmwareConfig())
        for i in range(10):
            pulse = exact(0.0005 * i, i)
            got = estimator.update([PositionPulse(0.004, T_K, i) if i == 5 else pulse], False)
            want = clean.update([pulse], False)
            assert got.valid
            if i == 5:
                assert got.samples == ()
            else:
                assert got.position_m == pytest.approx(want.position_m, abs=1e-12)
        assert not estimator.implausible

    def test_a_jump_is_left_out_and_its_end_believed(self) -> None:
        estimator = PositionEstimator(unfiltered(period_s=0.0025, max_speed_m_s=2.0))
        feed(estimator, [0.0])
        assert estimator.update([exact(0.0052, 1)], False).samples == ()  # 5.09 mm at most
        assert len(estimator.update([exact(0.0052, 2)], False).samples) == 1

    @pytest.mark.parametrize(
        "bad",
        [
            PositionPulse(0.0, T_K, 0),
            PositionPulse(0.004, T_K, 0),
            PositionPulse(0.0009, 100.0, 0),
            PositionPulse(0.0009, 500.0, 0),
        ],
    )
    def test_out_of_range_makes_it_implausible_after_three(self, bad: PositionPulse) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        feed(estimator, [0.0])
        for i in range(3):
            assert not estimator.implausible
            estimate = estimator.update(
                [PositionPulse(bad.pulse_s, bad.coil_temperature_k, 1 + i)], False
            )
        assert estimator.implausible
        assert not estimate.valid
        estimate = feed(estimator, [0.001] * 5, 4)
        assert not estimate.valid
        estimate = feed(estimator, [0.001], 9)
        assert estimate.valid
        assert not estimator.implausible
        assert estimate.position_m == estimate.raw_m  # afresh, not interpolated

    def test_never_in_range_is_implausible_too(self) -> None:
        estimator = PositionEstimator(FirmwareConfig())
        for i in range(3):
            estimate = estimator.update([PositionPulse(0.0, T_K, i)], False)
        assert estimator.implausible
        assert not estimate.valid

    @pytest.mark.parametrize("period_s", [0.01, 0.0025])
    def test_garbage_within_the_range_is_found(self, period_s: float) -> None:
        """Uniform noise over the whole stroke, 200 seeds: found within 0.13 s on average."""
        times_s = []
        for seed in range(200):
            rng = np.random.default_rng(seed)
            estimator = PositionEstimator(FirmwareConfig(sensor=SensorConfig(period_s=period_s)))
            samples = 0
            while not estimator.implausible:
                estimator.update([exact(float(rng.uniform(-0.01285, 0.01285)), samples)], False)
                samples += 1
                assert samples * period_s < 0.4
            times_s.append(samples * period_s)
        assert sum(times_s) / len(times_s) < 0.13

    @pytest.mark.parametrize("period_s", [0.01, 0.0025])
    def test_real_shifts_are_never_implausible(self, period_s: float) -> None:
        """Full strokes in 15 ms every 100 ms, with a tick of noise: the busiest driver there is."""
        rng = np.random.default_rng(3)
        estimator = PositionEstimator(FirmwareConfig(sensor=SensorConfig(period_s=period_s)))
        ends = [0.0, 0.01285, 0.0, -0.01285]
        for i in range(round(4.0 / period_s)):
            leg, inside_s = divmod(i * period_s, 0.1)
            start, end = ends[int(leg) % 4], ends[(int(leg) + 1) % 4]
            x_m = start + (end - start) * min(1.0, inside_s / 0.015) ** 2
            tick_m = float(rng.integers(-1, 2)) * 4.5e-5
            assert estimator.update([exact(x_m + tick_m, i)], False).valid
            assert not estimator.implausible

    def test_motion_is_seen_from_the_mark_on_in_both_directions(self) -> None:
        estimator = PositionEstimator(unfiltered())
        still_m = 2e-6 / 0.022
        feed(estimator, [0.0, 0.003])
        assert estimator.moved
        estimator.mark()
        assert not estimator.moved
        feed(estimator, [0.003 + 0.99 * still_m], 2)
        assert not estimator.moved
        feed(estimator, [0.003 - 0.02 * still_m], 3)
        assert estimator.moved
        estimator.mark()
        assert not estimator.moved
        feed(estimator, [0.003 - 1.1 * still_m], 4)
        assert estimator.moved
        feed(estimator, [0.003], 5)
        assert estimator.moved

    @pytest.mark.parametrize("sign", [-1, 1])
    def test_stuck_until_it_moves(self, sign: int) -> None:
        estimator = PositionEstimator(unfiltered())
        still_m = 2e-6 / 0.022
        feed(estimator, [0.001, 0.001])
        estimator.distrust()
        assert estimator.stuck
        feed(estimator, [0.001 + sign * 0.9 * still_m], 2)
        assert estimator.stuck
        feed(estimator, [0.001 + sign * 1.1 * still_m], 3)
        assert not estimator.stuck
        feed(estimator, [0.001], 4)
        assert not estimator.stuck

    def test_as_many_ticks_as_tell_of_no_motion(self) -> None:
        """All powers of two, so that ticks are exact: two are still, three are motion."""
        tick_s, slope_s_per_m = 2.0**-20, 2.0**-6
        sensor = {"timer_resolution_s": tick_s, "slope_s_per_m": slope_s_per_m, "t_mid_s": 2.0**-10}
        estimator = PositionEstimator(unfiltered(**sensor))

        def read(ticks: int, index: int) -> None:
            pulse_s = sensor["t_mid_s"] + ticks * tick_s
            estimator.update([PositionPulse(pulse_s, T_K, index)], False)

        read(100, 0)
        estimator.mark()
        estimator.distrust()
        for index, ticks in enumerate((98, 100, 102), 1):
            estimator.mark()
            read(ticks, index)
            assert estimator.stuck and not estimator.moved
        read(103, 4)
        assert estimator.moved and not estimator.stuck


@given(
    st.lists(
        st.lists(
            st.builds(
                PositionPulse, st.floats(0.0, 0.004), st.floats(0.0, 1000.0), st.integers(0, 255)
            ),
            max_size=6,
        ),
        max_size=40,
    ),
    st.booleans(),
)
@settings(max_examples=150, deadline=None)
def test_whatever_comes_the_estimate_stays_finite_and_in_bounds(
    steps: list[list[PositionPulse]], enabled: bool
) -> None:
    estimator = PositionEstimator(FirmwareConfig(filter=FilterConfig(enabled=enabled)))
    for batch in steps:
        estimate = estimator.update(batch, False)
        assert abs(estimate.raw_m) <= 0.01585
        assert abs(estimate.position_m) <= 0.01585 * 1.7424  # the filter's largest gain
        assert math.isfinite(estimate.velocity_m_s)
        assert len(estimate.samples) <= 4
        if estimate.samples:
            assert not estimator.implausible or not estimate.valid
