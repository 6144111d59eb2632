"""Velocity from two samples."""

from __future__ import annotations

import pytest

from controller.velocity import TwoSampleVelocity


def test_exact_on_a_ramp_and_half_a_period_late_otherwise() -> None:
    velocity = TwoSampleVelocity(0.01)
    velocity.settle(0.002)
    assert velocity.update(0.002) == 0.0
    assert velocity.update(0.012) == pytest.approx(1.0)
    assert velocity.update(0.022) == pytest.approx(1.0)
    assert velocity.update(0.0) == pytest.approx(-2.2)

    accelerating = TwoSampleVelocity(0.0025)
    a_m_s2 = 80.0
    for n in range(1, 20):
        t_s = n * 0.0025
        got = accelerating.update(0.5 * a_m_s2 * t_s**2)
        assert got == pytest.approx(a_m_s2 * (t_s - 0.00125))


def test_starts_at_rest_at_zero() -> None:
    assert TwoSampleVelocity(0.5).update(1.0) == 2.0
