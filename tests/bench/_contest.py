"""How contenders are compared: each at its cheapest setting that is accurate enough, by CPU time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from plant.effects.setup import Setup
from tests.bench._piston import Floats, Shown

IMPACT_S, SPEED_M_S, PRESSURE_PA = 1e-6, 1e-3, 200.0
SCIPY_SETTINGS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
OUR_SETTINGS = (5e-5, 2e-5, 1e-5, 7e-6, 5e-6, 2e-6, 1e-6, 1e-7)


def best_s(once: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of several CPU times, after one call that warms up."""
    once()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        once()
        times.append(time.process_time() - begin)
    return min(times)


def errors(found: Sequence[Shown], reference: Sequence[Shown]) -> tuple[float, float, float]:
    """Largest errors of impact time [s], impact speed [m/s] and pressure [Pa]."""
    pairs = list(zip(found, reference, strict=True))
    return (
        max(abs(a.impact_s - b.impact_s) for a, b in pairs),
        max(abs(a.speed_m_s - b.speed_m_s) for a, b in pairs),
        max(float(np.abs(a.pressures_pa - b.pressures_pa).max()) for a, b in pairs),
    )


def accurate(worst: tuple[float, float, float]) -> bool:
    """True if errors are within the limits (a missing impact is not)."""
    return worst[0] < IMPACT_S and worst[1] < SPEED_M_S and worst[2] < PRESSURE_PA


def cheapest(
    solve: Callable[[float], Sequence[Shown]],
    settings: Sequence[float],
    reference: Sequence[Shown],
) -> tuple[float, tuple[float, float, float]]:
    """First of the settings, loosest first, that is accurate enough, with its errors."""
    for setting in settings:
        try:
            worst = errors(solve(setting), reference)
        except RuntimeError:
            continue
        if accurate(worst):
            return setting, worst
    raise RuntimeError("no setting is accurate enough")


def row(
    name: str, each_s: float, floors_s: Sequence[float], setting: float, worst: tuple[float, ...]
) -> str:
    """One contender's line: CPU time a stroke, how many times as fast as each floor, its errors."""
    ratios = " ".join(f"{floor_s / each_s:8.0f} x" for floor_s in floors_s)
    return (
        f"{name:44} {1e6 * each_s:9.1f} us {ratios}   at {setting:.0e}: "
        f"{1e6 * worst[0]:.2f} us, {1e3 * worst[1]:.2f} mm/s, {worst[2]:.0f} Pa"
    )


def one_by_one(
    setups: Sequence[Setup],
    times: Floats,
    pressures: slice,
    reference: Sequence[Shown],
    floors_s: Sequence[float],
) -> str:
    """Our line for single strokes, called from Python one after the other."""
    from plant.batch.prediction import Predictor
    from plant.kernel.layout import EventRow

    samples = np.rint(times * 1e9).astype(np.int64)

    def solve(tolerance: float) -> list[Shown]:
        predictor = Predictor(samples, tolerance)
        found = []
        for setup in setups:
            states = predictor.states(setup)
            stop = next(
                e for e in predictor.happened if e[EventRow.speed] > 0.0 and e[EventRow.lost] > 0.0
            )
            found.append(Shown(stop[EventRow.time], stop[EventRow.speed], states[:, pressures]))
        return found

    setting, worst = cheapest(solve, OUR_SETTINGS, reference)
    predictor = Predictor(samples, setting)

    def loop() -> None:
        for setup in setups:
            predictor.states(setup)

    each_s = best_s(loop, 40) / len(setups)
    return row("ours, one by one from Python", each_s, floors_s, setting, worst)
