"""The length stroke with its three valves: our kernels against our own scipy path, the tests' judge."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import numpy as np

from tests.bench._contest import (
    OUR_SETTINGS,
    SCIPY_SETTINGS,
    Floats,
    Shown,
    best_s,
    cheapest,
    one_by_one,
    row,
)

KINDS = ("N-B", "B-N", "N-F", "F-N")
SUPPLIES_PA = (9e5, 7e5)
TIMES = np.linspace(0.0, 0.25, 251)
BATCH = 10_000


def measure() -> Iterator[str]:
    """Lines of the table; the judge is found when run from the repository's folder."""
    from plant.batch.batch import Strokes, simulate_batch
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.integrator.loop import DONE
    from plant.kernel.layout import LengthState, Parameters
    from plant.parameters import load
    from plant.systems.setup import make_setup
    from tests.varied_strokes import varied_strokes

    try:
        judge = importlib.import_module("tests.reference.actuator")
    except ImportError:
        yield "length stroke: its scipy path is tests/reference/actuator.py; run this in the repository"
        return
    cases = []
    for kind in KINDS:
        for supply_pa in SUPPLIES_PA:
            old, new = kind[0], kind[-1]
            cases.append(
                StrokeConditions(
                    kind, supply_pa, ((0.01, new, 0.98), (0.01, old, 0.0)), charged_before=(old,)
                )
            )

    def judges() -> list:
        """One judge a stroke; it remembers its valves, so each solves once."""
        return [
            judge.actuator(
                judge.Case(c.kind, c.supply_pressure_pa, c.commands, charged=c.charged_before)
            )
            for c in cases
        ]

    def by_scipy(tolerance: float, longest_s: float = np.inf) -> list[Shown]:
        found = []
        for actuator in judges():
            solution = actuator.solve(TIMES, rtol=tolerance, max_step=longest_s)
            stop = next(h for h in solution.happenings if h.name == "stop")
            first = actuator.first_pressure
            found.append(Shown(stop.time_s, stop.speed_m_s, solution.states[:, first : first + 3]))
        return found

    reference = by_scipy(1e-11, 5e-4)
    yield (
        f"length stroke: two valves switched, the third open to the atmosphere, {TIMES[-1]} s, "
        f"{len(TIMES)} samples; worst of {len(cases)} (four shifts, two supplies)"
    )
    setting, worst = cheapest(by_scipy, SCIPY_SETTINGS, reference)
    floor_s = best_s(lambda: by_scipy(setting), 2) / len(cases)
    yield row("the judge, scipy solve_ivp DOP853, events", floor_s, [floor_s], setting, worst)
    setups = [make_setup(load(), c) for c in cases]
    yield one_by_one(
        setups, TIMES, slice(LengthState.p_b, LengthState.p_f + 1), reference, [floor_s]
    )
    pressures = [LengthState.p_b, LengthState.p_n, LengthState.p_f]

    def together(tolerance: float) -> list[Shown]:
        found: list[Shown] = []
        for kind in KINDS:
            some = [s for s in setups if s.conditions.kind == kind]
            result = simulate_batch(
                Strokes.from_setups(some, TIMES[-1]),
                sample_s=TIMES, columns=pressures, tolerance=tolerance,
            )  # fmt: skip
            rows = zip(result.arrival_s, result.impact_speed_m_s, result.samples, strict=True)
            found += [Shown(*item) for item in rows]
        return found

    setting, worst = cheapest(together, OUR_SETTINGS, reference)
    draw = np.random.default_rng(2)
    changes: dict[int, float | Floats] = {
        Parameters.p_supply: draw.uniform(7e5, 1e6, BATCH),
        Parameters.m_s: setups[0].p.m_s * draw.uniform(0.8, 1.5, BATCH),
        Parameters.k_out: draw.uniform(0.9, 1.1, BATCH),
    }
    many = varied_strokes(setups[0], TIMES[-1], changes)
    result = simulate_batch(many, sample_s=TIMES, columns=pressures, tolerance=setting)
    if not (result.in_lanes.all() and (result.status == DONE).all()):
        raise RuntimeError("a stroke of the batch did not run")
    each_s = (
        best_s(
            lambda: simulate_batch(many, sample_s=TIMES, columns=pressures, tolerance=setting), 5
        )
        / BATCH
    )
    yield row(f"ours, {BATCH} N-B at once", each_s, [floor_s], setting, worst)
