"""One stroke, many strokes, gradients, two cores and the first start, beside what others need.

Every contender solves the same strokes at its cheapest setting that is accurate enough: impact time
within 1 us, impact speed within 1 mm/s, pressures within 200 Pa, all checked here against scipy at a
tolerance of 1e-12.  Times are CPU times, the best of several
runs: this measures solvers, not the machine's load.  Before the valve opens nothing moves, and LSODA
makes hard work of it; the peers, and LSODA in its second row, begin there, ours at the command.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from plant.setup import Setup

from ._piston import Floats, Piston, Shown, solve_with_scipy

IMPACT_S, SPEED_M_S, PRESSURE_PA = 1e-6, 1e-3, 200.0
END_S = 0.25
OPENING_S = 0.018
TIMES: Floats = np.unique(np.append(np.arange(251) * 1e-3, OPENING_S))
STROKES = 24
BATCH = 10_000
SCIPY_SETTINGS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
OUR_SETTINGS = (5e-5, 2e-5, 1e-5, 5e-6, 2e-6, 1e-6, 1e-7)


def measure() -> Iterator[str]:
    """Lines of the tables."""
    from . import _cold, _gradient, _length, _scaling

    yield from fixed_strokes()
    yield ""
    yield from _length.measure()
    yield ""
    yield from _gradient.measure()
    yield ""
    yield from _scaling.measure()
    yield ""
    yield from _cold.measure()


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
    from plant.integrate import EVENT_LOST, EVENT_SPEED, EVENT_TIME
    from plant.prediction import Predictor

    samples = np.rint(times * 1e9).astype(np.int64)

    def solve(tolerance: float) -> list[Shown]:
        predictor = Predictor(samples, tolerance)
        found = []
        for setup in setups:
            states = predictor.states(setup)
            stop = next(e for e in predictor.happened if e[EVENT_SPEED] > 0.0 and e[EVENT_LOST] > 0.0)
            found.append(Shown(stop[EVENT_TIME], stop[EVENT_SPEED], states[:, pressures]))
        return found

    setting, worst = cheapest(solve, OUR_SETTINGS, reference)
    predictor = Predictor(samples, setting)

    def loop() -> None:
        for setup in setups:
            predictor.states(setup)

    each_s = best_s(loop, 40) / len(setups)
    return row("ours, one by one from Python", each_s, floors_s, setting, worst)


def fixed_strokes() -> Iterator[str]:
    """One stroke of the fixed piston by each way, and ten thousand of ours at once."""
    from plant import layout as L
    from plant.batch import Strokes, simulate_batch
    from plant.integrate import DONE
    from plant.parameters import load
    from plant.setup import make_setup
    from plant.stroke_conditions import StrokeConditions

    base = make_setup(load(), StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),)))

    def drawn(n: int) -> dict[int, Floats]:
        draw = np.random.default_rng(1)
        spans = {
            L.P_SUPPLY: (7e5, 1e6),
            L.M_S: (0.8, 3.0),
            L.VOL_B: (0.8 * base.p[L.VOL_B], 1.5 * base.p[L.VOL_B]),
            L.VOL_N: (0.9 * base.p[L.VOL_N], 1.1 * base.p[L.VOL_N]),
            L.F_RUN_S: (40.0, 60.0),
            L.K_IN: (0.9, 1.1),
        }
        return {place: draw.uniform(low, high, n) for place, (low, high) in spans.items()}

    changes = drawn(STROKES)
    setups = [replace(base, p=base.p.copy()) for _ in range(STROKES)]
    for place, values in changes.items():
        for setup, value in zip(setups, values, strict=True):
            setup.p[place] = value
    pistons = [Piston.of(setup) for setup in setups]
    opening = [(OPENING_S, 0, 1)]
    reference = [solve_with_scipy(p, opening, TIMES, "DOP853", 1e-12) for p in pistons]
    yield f"fixed piston: command at 10 ms, {END_S} s, {len(TIMES)} samples; errors: worst of {STROKES} different strokes"

    yield f"{'':44} {'CPU time':>12} {'LSODA':>10} {'LSODA*':>10}   * begun when the valve opens"
    floors_s: list[float] = []
    for method, begin_s in (("LSODA", 0.0), ("LSODA", OPENING_S), ("RK45", OPENING_S)):

        def by_scipy(
            tolerance: float, method: str = method, begin_s: float = begin_s
        ) -> list[Shown]:
            return [
                solve_with_scipy(p, opening, TIMES, method, tolerance, begin_s) for p in pistons
            ]

        setting, worst = cheapest(by_scipy, SCIPY_SETTINGS, reference)
        each_s = best_s(lambda: by_scipy(setting), 3) / STROKES  # noqa: B023 - called at once
        if method == "LSODA":
            floors_s.append(each_s)
        star = "*" if begin_s else ""
        yield row(f"scipy solve_ivp {method}{star}, events", each_s, floors_s, setting, worst)

    yield from peers(pistons[:3], reference[:3], floors_s)

    yield one_by_one(setups, TIMES, slice(L.FP1, L.FP2 + 1), reference, floors_s)

    def together(tolerance: float) -> list[Shown]:
        result = simulate_batch(
            Strokes.varied(base, END_S, changes),
            sample_s=TIMES, columns=[L.FP1, L.FP2], tolerance=tolerance,
        )  # fmt: skip
        rows = zip(result.arrival_s, result.impact_speed_m_s, result.samples, strict=True)
        return [Shown(*item) for item in rows]

    setting, worst = cheapest(together, OUR_SETTINGS, reference)
    many = Strokes.varied(base, END_S, drawn(BATCH))
    exact = simulate_batch(many, tolerance=1e-10, lanes=False)
    result = simulate_batch(many, tolerance=setting)
    if not (result.in_lanes.all() and (result.status == DONE).all()):
        raise RuntimeError("a stroke of the batch did not run")
    for columns, what in (([L.FP1, L.FP2], f"{len(TIMES)} samples each"), ([], "impact and end state")):
        each_s = (
            best_s(
                lambda: simulate_batch(many, sample_s=TIMES, columns=columns, tolerance=setting)  # noqa: B023
                if columns  # noqa: B023
                else simulate_batch(many, tolerance=setting),
                5,
            )
            / BATCH
        )
        yield row(f"ours, {BATCH} at once, {what}", each_s, floors_s, setting, worst)
    late = np.abs(result.arrival_s - exact.arrival_s)
    yield (
        f"the batch against the scalar kernel at 1e-10: impact within {1e6 * late.max():.2f} us, "
        f"{1e3 * np.abs(result.impact_speed_m_s - exact.impact_speed_m_s).max():.2f} mm/s, end state "
        f"{np.abs(result.final[:, L.FP1 : L.FP2 + 1] - exact.final[:, L.FP1 : L.FP2 + 1]).max():.1f} Pa"
    )


def peers(
    pistons: Sequence[Piston], reference: Sequence[Shown], floors_s: Sequence[float]
) -> Iterator[str]:
    """The peers that are installed; which are not."""
    from . import _heyoka, _numbalsoda

    for name, module in (("heyoka", _heyoka), ("numbalsoda", _numbalsoda)):
        version = module.version()
        if version is None:
            yield f"{name}: not installed (pip install {name}; not a dependency)"
            continue
        solvers: dict[float, list[Callable[[], Shown]]] = {}

        def solve(
            tolerance: float, solvers: dict = solvers, module: object = module
        ) -> list[Shown]:
            solvers[tolerance] = [
                module.solver(p, OPENING_S, TIMES, tolerance)  # type: ignore[attr-defined]
                for p in pistons
            ]
            return [one() for one in solvers[tolerance]]

        try:
            setting, worst = cheapest(solve, module.SETTINGS, reference)
        except (ImportError, OSError) as error:
            yield f"{name} {version}: does not load: {error}"
            continue
        ready = solvers[setting]
        each_s = best_s(lambda: [one() for one in ready], 40) / len(ready)  # noqa: B023
        yield row(f"{name} {version}*, events, one by one", each_s, floors_s, setting, worst)
