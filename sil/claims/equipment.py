"""Chapter 2: positions, control unit, sensors."""

from __future__ import annotations

from functools import cache

import numpy as np

from sil.claims.claim import GIVEN, NOT_MET, OPEN, PARTLY, Outcome, judged
from sil.claims.strokes import nominal, plain, run, value
from sil.simulation.in_memory import MemoryRun, run_in_memory


@cache
def loop(name: str, *settings: str) -> MemoryRun:
    """Return a shipped scenario run in memory."""
    from sil.simulation.scenario import load

    return run_in_memory(load(name, settings=list(settings)))


def _f01_three_positions() -> Outcome:
    ends = {kind: plain(kind).position_m[-1] for kind in ("N-B", "B-N", "N-F", "F-N")}
    stroke = value("length.stroke")
    goal = {"N-B": stroke, "B-N": 0.0, "N-F": -stroke, "F-N": 0.0}
    good = all(abs(ends[kind] - goal[kind]) < 1e-6 for kind in goal)
    return judged(good, *(1e3 * ends[kind] for kind in goal))


def _f02_sampling() -> Outcome:
    from can_dbc.messages import ControllerStatus

    periods = []
    for name in ("lab_n_b", "firmware_2500us"):
        times, _ = loop(name).record.series(ControllerStatus, "estimate_m")
        periods.append(float(np.mean(np.diff(times))))
    good = abs(periods[0] - 0.010) < 1e-4 and abs(periods[1] - 0.0025) < 1e-4
    return judged(good, *(1e3 * period for period in periods))


def _f03_processor() -> Outcome:
    clock = value("opc4.clock")
    return Outcome(OPEN, (clock / 1e6,))


def _f04_gauges() -> Outcome:
    highest = max(
        float(np.max(plain(kind).pressure_pa(name)))
        for kind in ("fixed", "N-B", "B-N")
        for name in plain(kind).conditions.chambers
    )
    damped = run("fixed", load="damper")
    oil = float(np.max(damped.pressure_pa("oil2")))
    good = highest <= value("gauge.range_air") and oil <= value("gauge.range_oil")
    share = 1e-3 * value("gauge.accuracy_fro")
    errors = (share * value(f"gauge.range_{medium}") for medium in ("air", "oil"))
    return judged(good, highest / 1e5, oil / 1e5, *errors)


def _f05_potentiometer() -> Outcome:
    share = value("potentiometer.start_force_max") / value("friction_fixed.F_sf")
    good = value("potentiometer.resolution") == 5e-5 and share <= 0.03
    return Outcome(GIVEN if good else NOT_MET, (100 * share,))


def _f06_pulse() -> Outcome:
    from plant.devices.sensors import InductiveSensor

    sensor = InductiveSensor.from_parameters(nominal())
    stroke = value("length.stroke")
    ends = [float(sensor.duration_s(x, 293.15)) for x in (-stroke, 0.0, stroke)]
    warm = sensor.pulse_s(0.006, 353.15)
    back = float(sensor.position_m(warm, 353.15))
    good = abs(ends[1] - 9e-4) < 1e-5 and abs(back - 0.006) < 5e-5
    return judged(good, *(1e3 * end for end in ends), 1e3 * back)


PHASES = tuple(0.0005 * k for k in range(20))


@cache
def lags(*settings: str) -> tuple[float, float]:
    """Return the lag of the held position [s] at 10 % and 90 % of travel, averaged over the phase."""
    from sil.simulation.scenario import load

    found = []
    for phase in PHASES:
        # the firmware pushes at a tick: only the valve can move the motion against the raster
        loaded = load("lab_n_b", settings=[*settings, f"valve.D_rise={0.008 + phase}"])
        shift = run_in_memory(loaded).shifts[0]
        found.append((shift.position_lag_10_held_s, shift.position_lag_90_held_s))
    mean = np.mean(np.array(found, dtype=float), axis=0)
    return float(mean[0]), float(mean[1])


def _f07_sensor_lag() -> Outcome:
    early, late = lags()
    good = abs(early - 0.030) < 0.003 and abs(late - 0.040) < 0.003
    return judged(good, 1e3 * early, 1e3 * late, len(PHASES))


def _f08_unfiltered_lag() -> Outcome:
    early, late = lags("controller.filter.enabled=false")
    slow = lags()
    ratio = sum(slow) / (early + late)
    good = 2.6 <= ratio <= 4.2 and abs(late - early) < 0.0015
    return judged(good, 1e3 * early, 1e3 * late, ratio)


def _f09_slower_in_truck() -> Outcome:
    shift = loop("truck_into_gear_2200n").shifts[-1]
    late = shift.position_lag_90_s
    lab = loop("lab_n_b").shifts[0].position_lag_90_s
    return Outcome(NOT_MET, (1e3 * (late or 0), 1e3 * (lab or 0)))


def _f10_fast_sampling() -> Outcome:
    from can_dbc.messages import PositionPulse

    times, _ = loop("firmware_2500us").record.series(PositionPulse, "pulse_s")
    period = float(np.mean(np.diff(times)))
    longest = max(loop("firmware_2500us").record.series(PositionPulse, "pulse_s")[1])
    good = 0.002 <= period <= 0.003 and 2 * longest <= period
    return judged(good, 1e3 * period, 1e3 * longest)


def _f11_scope() -> Outcome:
    rate = value("scope.rate")
    step = float(np.median(np.diff(plain("fixed").time_s)))
    return judged(rate == 10000.0 and abs(step - 0.0001) < 1e-12, 1 / step, otherwise=PARTLY)
