"""How late the position is that a listener on the bus holds (thesis 2.2.4, figure 2.4).

The pulse tells the position 0.45 ms after its start; the newest one that a tick can use starts
5 ms before it; the status is on the bus 0.4 ms after the tick and stands until the next one.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from can_dbc.messages import E2eState, PositionPulse
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.settings import FilterConfig, SensorConfig
from tests.support.toy_actuator import pulse_s
from tests.unit.controller.test_filters import delay_at_rest_s

STROKE_M = 0.01285
STROKE_S = 0.015
MEASURED_S = 0.00045
PUBLISHED_S = 0.0004
PHASES = 25

Path = Callable[[float], float]


def accelerated(t_s: float) -> float:
    """A stroke of 15 ms under constant force."""
    return STROKE_M * min(max(t_s / STROKE_S, 0.0), 1.0) ** 2


def uniform(t_s: float) -> float:
    """A stroke of 15 ms at constant speed."""
    return STROKE_M * min(max(t_s / STROKE_S, 0.0), 1.0)


def estimates(
    config: FirmwareConfig, path: Path, started_s: float, lead_s: float
) -> list[tuple[float, float]]:
    """Return (time, estimate) of every status while the stay moves along a path."""
    firmware = Firmware(config)
    sensor_s = config.sensor.period_s
    reported: list[tuple[float, float]] = []
    taken = 0
    for k in range(round(0.35 / config.period_s)):
        tick_s = k * config.period_s
        pulses = []
        while (start_s := (taken + 1) * sensor_s - lead_s) <= tick_s - lead_s + 1e-9:
            position_m = path(start_s + MEASURED_S - started_s)
            pulses.append(PositionPulse(pulse_s(position_m), 293.15, taken % 256))
            taken += 1
        inputs = Inputs(tuple(pulses), position_state=E2eState.VALID)
        out = firmware.step(k * config.period_ns, inputs)
        reported.append((tick_s + PUBLISHED_S, out.status.estimate_m))
    return reported


def first_above(reported: list[tuple[float, float]], level_m: float) -> float:
    return next(time_s for time_s, estimate_m in reported if estimate_m >= level_m)


def lags_ms(config: FirmwareConfig, path: Path, lead_s: float) -> tuple[float, float]:
    """Mean lag at 10 % and at 90 % of the travel over all phases of the sampling."""
    low_s = high_s = 0.0
    for phase in range(PHASES):
        started_s = 0.1 + phase / PHASES * config.period_s
        reported = estimates(config, path, started_s, lead_s)
        for share in (0.1, 0.9):
            true_s = next(t * 1e-5 for t in range(2000) if path(t * 1e-5) >= share * STROKE_M)
            lag_s = first_above(reported, share * STROKE_M) - started_s - true_s
            if share == 0.1:
                low_s += lag_s
            else:
                high_s += lag_s
    return 1e3 * low_s / PHASES, 1e3 * high_s / PHASES


def show(what: str, lags: tuple[float, float]) -> None:
    print(f"{what}: {lags[0]:.1f} ms at 10 %, {lags[1]:.1f} ms at 90 % of the travel")


@pytest.mark.parametrize("path", [accelerated, uniform])
def test_with_todays_filter_30_ms_growing_to_40(path: Path) -> None:
    lags = lags_ms(FirmwareConfig(), path, lead_s=0.005)
    show(f"filter, {path.__name__}", lags)
    assert lags[0] == pytest.approx(30.0, abs=2.5)
    assert lags[1] == pytest.approx(40.0, abs=2.5)


@pytest.mark.parametrize("path", [accelerated, uniform])
def test_without_filter_10_ms_throughout(path: Path) -> None:
    """5.0 - 0.45 + 0.4 ms to the status, and 5 ms until it is there on average."""
    lags = lags_ms(FirmwareConfig(filter=FilterConfig(enabled=False)), path, lead_s=0.005)
    show(f"no filter, {path.__name__}", lags)
    assert lags[0] == pytest.approx(9.95, abs=0.4)
    assert lags[1] == pytest.approx(9.95, abs=0.4)


def test_the_filter_costs_a_factor_three() -> None:
    with_it = lags_ms(FirmwareConfig(), accelerated, lead_s=0.005)
    without = lags_ms(FirmwareConfig(filter=FilterConfig(enabled=False)), accelerated, 0.005)
    assert 2.7 < with_it[0] / without[0] < 3.4


def test_a_slow_ramp_lags_by_the_closed_form() -> None:
    """Filter delay at rest 23.35 ms + 4.55 + 0.4 + mean hold 5 ms."""

    def slow(t_s: float) -> float:
        return 0.05 * min(max(t_s, 0.0), 0.2)

    lags = []
    for phase in range(PHASES):
        started_s = 0.1 + phase / PHASES * 0.01
        reported = estimates(FirmwareConfig(), slow, started_s, 0.005)
        lags.append(first_above(reported, 0.008) - started_s - 0.16)
    mean_ms = 1e3 * sum(lags) / PHASES
    closed_ms = 1e3 * delay_at_rest_s(6, 22.0, 100.0) + 5.0 - 0.45 + 0.4 + 5.0
    assert mean_ms == pytest.approx(closed_ms, abs=0.7)  # a timer tick is 0.9 ms of this ramp


@pytest.mark.parametrize(
    ("period_s", "expected_ms"),
    [
        (0.0025, 2.5 - 0.45 + 0.4 + 1.25),  # pulse just done at the tick, short hold
        (0.01, 2.5 - 0.45 + 0.4 + 5.0),  # the hold of the firmware dominates
    ],
)
def test_fast_sampling_without_filter(period_s: float, expected_ms: float) -> None:
    config = FirmwareConfig(
        period_s=period_s,
        sensor=SensorConfig(period_s=0.0025),
        filter=FilterConfig(enabled=False),
    )
    lags = lags_ms(config, accelerated, lead_s=0.0025)
    show(f"2.5 ms sampling, {1e3 * period_s} ms firmware", lags)
    assert lags[0] == pytest.approx(expected_ms, abs=0.5)
    assert lags[1] == pytest.approx(expected_ms, abs=0.5)


def test_fast_sampling_with_a_22_hz_filter_still_waits_for_the_filter() -> None:
    """The filter's delay is set by its cut-off, not by the sampling."""
    config = FirmwareConfig(period_s=0.0025, sensor=SensorConfig(period_s=0.0025))
    lags = lags_ms(config, accelerated, lead_s=0.0025)
    show("2.5 ms sampling, 22 Hz filter", lags)
    floor_ms = 2.5 - 0.45 + 0.4 + 1.25
    filter_ms = 1e3 * delay_at_rest_s(6, 22.0, 400.0)
    assert lags[0] - floor_ms == pytest.approx(filter_ms, abs=8.0)
    assert lags[1] > lags[0] + 5.0
