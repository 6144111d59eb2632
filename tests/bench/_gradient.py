"""Ten derivatives of a stroke's samples, in plain strokes, and their error through the events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tests.bench._contest import Floats, best_s

TIMES = np.linspace(0.0, 0.3, 301)
REFERENCE_SHARE = 3e-5


def measure() -> Iterator[str]:
    from plant.batch.batch import BATCH_TOLERANCE, Strokes, simulate_batch
    from plant.batch.prediction import MOVE, Followers, Predictor
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.kernel.layout import FixedState, LengthState, Parameters
    from plant.parameters import load
    from plant.systems.setup import make_setup
    from tests.varied_strokes import varied_strokes

    common = (
        Parameters.p_supply,
        Parameters.k_in,
        Parameters.k_out,
        Parameters.vol_b,
        Parameters.vol_n,
        Parameters.m_s,
        Parameters.f_run_s,
        Parameters.alpha_m1,
    )
    yield f"gradient: {len(TIMES)} samples of position and pressures by 10 parameters, events moving along"
    for kind, commands, charged, own, columns in (
        (
            "fixed",
            ((0.01, "1", 0.98),),
            (),
            (Parameters.f_static_s, Parameters.beta_s),
            (FixedState.x, FixedState.p_1, FixedState.p_2),
        ),
        (
            "N-B",
            ((0.01, "B", 0.98), (0.01, "N", 0.0)),
            ("N",),
            (Parameters.f_run_p, Parameters.beta_p),
            (LengthState.x_s, LengthState.p_b, LengthState.p_n, LengthState.p_f),
        ),
    ):
        setup = make_setup(load(), StrokeConditions(kind, 9e5, commands, charged_before=charged))
        places = common + own
        size = np.array([1e-3, *[1e5] * (len(columns) - 1)])

        def moved(share: float) -> Strokes:
            number = np.arange(len(places) + 1)  # noqa: B023 - called at once
            changes: dict[int, float | Floats] = {
                place: setup.p[place] * (1.0 + share * (number == k + 1))  # noqa: B023
                for k, place in enumerate(places)  # noqa: B023
            }
            return varied_strokes(setup, TIMES[-1], changes)  # noqa: B023

        strokes = moved(MOVE)
        followers = Followers(TIMES)
        _, samples, alike = followers.run(strokes, columns, BATCH_TOLERANCE)
        up, down = (
            simulate_batch(
                moved(share), sample_s=TIMES, columns=columns, tolerance=1e-12, lanes=False
            ).samples
            for share in (REFERENCE_SHARE, -REFERENCE_SHARE)
        )
        ours = (samples[1:] - samples[0]) / MOVE / size
        exact = (up[1:] - down[1:]) / (2.0 * REFERENCE_SHARE) / size
        worst = max(
            float(np.linalg.norm(a - b) / np.linalg.norm(b))
            for a, b in zip(ours, exact, strict=True)
        )
        predictor = Predictor(np.rint(TIMES * 1e9).astype(np.int64))
        plain_s = best_s(lambda: predictor.states(setup), 300)  # noqa: B023
        kernel_s = best_s(lambda: followers.run(strokes, columns, BATCH_TOLERANCE), 300)  # noqa: B023
        twins = [setup] + [replace(setup, p=Parameters(p.copy())) for p in strokes.packed[1:]]
        whole_s = best_s(lambda: predictor.derivatives(setup, twins[1:], [MOVE] * 10, columns), 100)  # noqa: B023
        yield (
            f"{kind:6} plain stroke {1e6 * plain_s:6.0f} us   gradient {1e6 * kernel_s:6.0f} us = "
            f"{kernel_s / plain_s:4.1f} strokes ({whole_s / plain_s:.1f} with every setup packed anew)   "
            f"{int(alike[1:].sum())} of 10 along the same events, largest error {worst:.0e} of a derivative's norm"
        )
