"""One stroke, many strokes, gradients, two cores and the first start, compared with what others need.

Every contender solves the same strokes at its cheapest setting that is accurate enough: impact time
within 1 us, impact speed within 1 mm/s, pressures within 200 Pa, all checked here against scipy at a
tolerance of 1e-12.  Times are CPU times, the best of several
runs: this measures solvers, not the machine's load.  Before the valve opens nothing moves, and LSODA
makes hard work of it; the peers, and LSODA in its second row, begin there, ours at the command.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tests.bench._contest import (
    OUR_SETTINGS,
    SCIPY_SETTINGS,
    Floats,
    Piston,
    Shown,
    best_s,
    cheapest,
    one_by_one,
    row,
    solve_with_scipy,
)

END_S = 0.25
OPENING_S = 0.018
TIMES: Floats = np.unique(np.append(np.arange(251) * 1e-3, OPENING_S))
STROKES = 24
BATCH = 10_000


def measure() -> Iterator[str]:
    from tests.bench import _gradient, _length, _machine

    yield from fixed_strokes()
    yield ""
    yield from _length.measure()
    yield ""
    yield from _gradient.measure()
    yield ""
    yield from _machine.two_cores()
    yield ""
    yield from _machine.first_start()


def fixed_strokes() -> Iterator[str]:
    """One stroke of the fixed piston by each way, and ten thousand of ours at once."""
    from plant.batch.batch import simulate_batch
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.integrator.loop import DONE
    from plant.kernel.layout import FixedState, Parameters
    from plant.parameters import load
    from plant.systems.setup import make_setup
    from tests.varied_strokes import varied_strokes

    base = make_setup(load(), StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),)))

    def drawn(n: int) -> dict[int, Floats]:
        draw = np.random.default_rng(1)
        spans = {
            Parameters.p_supply: (7e5, 1e6),
            Parameters.m_s: (0.8, 3.0),
            Parameters.vol_b: (0.8 * base.p.vol_b, 1.5 * base.p.vol_b),
            Parameters.vol_n: (0.9 * base.p.vol_n, 1.1 * base.p.vol_n),
            Parameters.f_run_s: (40.0, 60.0),
            Parameters.k_in: (0.9, 1.1),
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

    yield one_by_one(setups, TIMES, slice(FixedState.p_1, FixedState.p_2 + 1), reference, floors_s)

    def together(tolerance: float) -> list[Shown]:
        result = simulate_batch(
            varied_strokes(base, END_S, changes),
            sample_s=TIMES, columns=[FixedState.p_1, FixedState.p_2], tolerance=tolerance,
        )  # fmt: skip
        rows = zip(result.arrival_s, result.impact_speed_m_s, result.samples, strict=True)
        return [Shown(*item) for item in rows]

    setting, worst = cheapest(together, OUR_SETTINGS, reference)
    many = varied_strokes(base, END_S, drawn(BATCH))
    exact = simulate_batch(many, tolerance=1e-10, lanes=False)
    result = simulate_batch(many, tolerance=setting)
    if not (result.in_lanes.all() and (result.status == DONE).all()):
        raise RuntimeError("a stroke of the batch did not run")
    for columns, what in (
        ([FixedState.p_1, FixedState.p_2], f"{len(TIMES)} samples each"),
        ([], "impact and end state"),
    ):
        each_s = (
            best_s(
                lambda: (
                    simulate_batch(many, sample_s=TIMES, columns=columns, tolerance=setting)  # noqa: B023
                    if columns  # noqa: B023
                    else simulate_batch(many, tolerance=setting)
                ),
                5,
            )
            / BATCH
        )
        yield row(f"ours, {BATCH} at once, {what}", each_s, floors_s, setting, worst)
    late = np.abs(result.arrival_s - exact.arrival_s)
    yield (
        f"the batch against the scalar kernel at 1e-10: impact within {1e6 * late.max():.2f} us, "
        f"{1e3 * np.abs(result.impact_speed_m_s - exact.impact_speed_m_s).max():.2f} mm/s, end state "
        f"{np.abs(result.final[:, FixedState.p_1 : FixedState.p_2 + 1] - exact.final[:, FixedState.p_1 : FixedState.p_2 + 1]).max():.1f} Pa"
    )
