"""Chapter 2: positions, control unit, sensors."""

from __future__ import annotations

from functools import cache

import numpy as np

from can_dbc.messages import PositionPulse
from plant.devices.sensors import InductiveSensor
from tests.claims.claim import GIVEN, NOT_MET, OPEN, PARTLY, Outcome, judged
from tests.claims.strokes import loop, ms, nominal, peak_bar, plain, run, value

PHASES = tuple(0.0005 * k for k in range(20))


def _f01_three_positions() -> Outcome:
    stroke = value("length.stroke")
    goal = {"N-B": stroke, "B-N": 0.0, "N-F": -stroke, "F-N": 0.0}
    ends = [plain(kind).position_m[-1] for kind in goal]
    good = all(abs(end - at) < 1e-6 for end, at in zip(ends, goal.values(), strict=True))
    return judged(good, *ms(*ends))


def _f02_sampling() -> Outcome:
    slow, fast = (
        float(np.mean(np.diff(loop(name).record.estimate[0])))
        for name in ("lab_n_b", "firmware_2500us")
    )
    return judged(abs(slow - 0.010) < 1e-4 and abs(fast - 0.0025) < 1e-4, *ms(slow, fast))


def _f03_processor() -> Outcome:
    return Outcome(OPEN, (value("opc4.clock") / 1e6,))


def _f04_gauges() -> Outcome:
    strokes = [plain(kind) for kind in ("fixed", "N-B", "B-N")]
    air_bar = max(
        peak_bar(stroke, name) for stroke in strokes for name in stroke.conditions.chambers
    )
    oil_bar = peak_bar(run("fixed", load="damper"), "oil2")
    ranges_pa = [value(f"gauge.range_{medium}") for medium in ("air", "oil")]
    errors = [1e-3 * value("gauge.accuracy_fro") * range_pa for range_pa in ranges_pa]
    good = 1e5 * air_bar <= ranges_pa[0] and 1e5 * oil_bar <= ranges_pa[1]
    return judged(good, air_bar, oil_bar, *errors)


def _f05_potentiometer() -> Outcome:
    share = value("potentiometer.start_force_max") / value("friction_fixed.F_sf")
    good = value("potentiometer.resolution") == 5e-5 and share <= 0.03
    return judged(good, 100 * share, verdict=GIVEN)


def _f06_pulse() -> Outcome:
    sensor, stroke = InductiveSensor.from_parameters(nominal()), value("length.stroke")
    ends = [float(sensor.duration_s(x, 293.15)) for x in (-stroke, 0.0, stroke)]
    back = float(sensor.position_m(sensor.pulse_s(0.006, 353.15), 353.15))
    return judged(abs(ends[1] - 9e-4) < 1e-5 and abs(back - 0.006) < 5e-5, *ms(*ends, back))


@cache
def lags(filtered: bool = True) -> tuple[float, float]:
    """Return the lag of the held position [s] at 10 % and 90 % of travel, averaged over the phase."""
    # the firmware pushes at a tick: only the valve can move the motion against the raster
    shifts = [
        loop(
            "lab_n_b", **{"controller.filter.enabled": filtered, "valve.D_rise": 0.008 + p}
        ).shifts[0]
        for p in PHASES
    ]
    found = [(shift.position_lag_10_held_s, shift.position_lag_90_held_s) for shift in shifts]
    early, late = np.mean(np.array(found, dtype=float), axis=0)
    return float(early), float(late)


def _f07_sensor_lag() -> Outcome:
    early, late = lags()
    good = abs(early - 0.030) < 0.003 and abs(late - 0.040) < 0.003
    return judged(good, *ms(early, late), len(PHASES))


def _f08_unfiltered_lag() -> Outcome:
    early, late = lags(False)
    ratio = sum(lags()) / (early + late)
    return judged(2.6 <= ratio <= 4.2 and abs(late - early) < 0.0015, *ms(early, late), ratio)


def _f09_slower_in_truck() -> Outcome:
    truck, lab = loop("truck_into_gear_2200n").shifts[-1], loop("lab_n_b").shifts[0]
    return Outcome(NOT_MET, ms(truck.position_lag_90_s or 0, lab.position_lag_90_s or 0))


def _f10_fast_sampling() -> Outcome:
    times_s, pulses_s = loop("firmware_2500us").record.series(PositionPulse, "pulse_s")
    period, longest = float(np.mean(np.diff(times_s))), max(pulses_s)
    return judged(0.002 <= period <= 0.003 and 2 * longest <= period, *ms(period, longest))


def _f11_scope() -> Outcome:
    step = float(np.median(np.diff(plain("fixed").time_s)))
    good = value("scope.rate") == 10000.0 and abs(step - 0.0001) < 1e-12
    return judged(good, 1 / step, otherwise=PARTLY)
