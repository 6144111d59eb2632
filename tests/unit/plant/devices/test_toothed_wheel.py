"""Shaft speeds from teeth and a timer: their steps, their noise, and a shaft at rest."""

from __future__ import annotations

import numpy as np
import pytest

from plant.devices.toothed_wheel import ToothedWheel

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
