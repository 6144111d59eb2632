"""Derivatives along a frozen sequence of steps against central differences of exact runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.batch.batch import Strokes, simulate_batch
from plant.batch.prediction import MOVE, Followers, Predictor
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.integrator.loop import DONE
from plant.kernel.layout import FixedState, LengthState, Parameters
from plant.parameters import load
from plant.systems.setup import make_setup
from tests.varied_strokes import varied_strokes

TIME_S = np.linspace(0.0, 0.25, 251)
FRICTION = {
    "fixed": (Parameters.f_static_s, Parameters.beta_s),
    "N-B": (Parameters.f_run_p, Parameters.beta_p),
}
MOVED = (
    Parameters.p_supply,
    Parameters.k_in,
    Parameters.k_out,
    Parameters.vol_b,
    Parameters.vol_n,
    Parameters.m_s,
    Parameters.f_run_s,
    Parameters.alpha_m1,
)
COLUMNS = {
    "fixed": (FixedState.x, FixedState.p_1, FixedState.p_2),
    "N-B": (LengthState.x_s, LengthState.p_b, LengthState.p_n, LengthState.p_f),
}
SIZE = {"fixed": (1e-3, 1e5, 1e5), "N-B": (1e-3, 1e5, 1e5, 1e5)}
COMMANDS = {
    "fixed": (((0.01, "1", 0.98),), ()),
    "N-B": (((0.01, "B", 0.98), (0.01, "N", 0.0)), ("N",)),
}


def setup(kind: str, **more: object) -> Setup:
    commands, charged = COMMANDS[kind]
    return make_setup(load(), StrokeConditions(kind, 9e5, commands, charged_before=charged, **more))


def moved(base: Setup, places: tuple[int, ...], share: float) -> Strokes:
    """The stroke, then the stroke with each parameter moved by a share of itself."""
    rows = np.arange(len(places) + 1)
    changes = {i: base.p[i] * (1.0 + share * (rows == k + 1)) for k, i in enumerate(places)}
    return varied_strokes(base, TIME_S[-1], changes)


@pytest.mark.parametrize("kind", sorted(COMMANDS))
def test_ten_parameters_agree_with_differences_of_exact_runs(kind: str) -> None:
    base = setup(kind)
    places = MOVED + FRICTION[kind]
    status, samples, alike = Followers(TIME_S).run(moved(base, places, MOVE), COLUMNS[kind], 1e-6)
    assert status == DONE and alike.all()
    exact = [
        simulate_batch(
            moved(base, places, share),
            sample_s=TIME_S, columns=COLUMNS[kind], tolerance=1e-12, lanes=False,
        ).samples
        for share in (3e-5, -3e-5)
    ]  # fmt: skip
    for k in range(1, len(places) + 1):
        ours = (samples[k] - samples[0]) / MOVE / SIZE[kind]
        theirs = (exact[0][k] - exact[1][k]) / 6e-5 / SIZE[kind]
        assert np.linalg.norm(theirs) > 1e-2
        assert np.linalg.norm(ours - theirs) < 1e-3 * np.linalg.norm(theirs)


def test_delays_and_lags_have_derivatives_too() -> None:
    base = setup("fixed")
    base.gauge_lag_s = 2e-3
    late, lagging = base.copy(), base.copy()
    late.timing = replace(late.timing, rise_ns=late.timing.rise_ns + 20)
    lagging.gauge_lag_s *= 1.0 + MOVE
    predictor = Predictor(np.rint(TIME_S * 1e9).astype(np.int64), 1e-9)
    states, (by_delay, by_lag) = predictor.derivatives(
        base, [late, lagging], [20e-9, 2e-3 * MOVE], tolerance=1e-9
    )
    assert np.abs(states - predictor.states(base)).max() < 1.0
    assert by_delay is not None and by_lag is not None
    # everything behind the switch happens later: d/d(delay) = -d/dt
    pressure = states[:, FixedState.p_1]
    slope = (pressure[2:] - pressure[:-2]) / (TIME_S[2] - TIME_S[0])
    smooth = (TIME_S[1:-1] > 0.06) & (TIME_S[1:-1] < 0.2)
    assert by_delay[1:-1, FixedState.p_1][smooth] == pytest.approx(-slope[smooth], rel=2e-3)
    twin = base.copy()
    twin.gauge_lag_s *= 1.01
    expected = (predictor.states(twin) - states) / (0.01 * base.gauge_lag_s)
    assert (
        np.abs(by_lag - expected)[:, FixedState.p_1].max()
        < 0.02 * np.abs(expected[:, FixedState.p_1]).max()
    )


def test_a_neighbour_with_other_events_has_none() -> None:
    base = setup("fixed")
    stuck, near = base.copy(), base.copy()
    stuck.p.f_static_s = 5000.0
    near.p.m_s *= 1.0 + MOVE
    predictor = Predictor(np.rint(TIME_S * 1e9).astype(np.int64))
    _, (first, second) = predictor.derivatives(base, [stuck, near], [1.0, 1.0])
    assert first is None and second is not None


TRUCK = {"mounted": True, "mesh_force_n": 500.0, "sync_impulse_n_s": 10.0}
COMPRESSIBLE = {"load": "damper", "damper_model": "compressible"}
INCOMPRESSIBLE = {"load": "damper", "damper_model": "incompressible"}
# a step across a corner of the damper's law is right to its square, its derivative only to the step's length
CORNERS = (Parameters.a_small, Parameters.rho_oil, Parameters.m_s, Parameters.f_run_s)


@pytest.mark.parametrize(
    ("kind", "conditions", "leak", "places"),
    [
        ("N-B", COMPRESSIBLE, 0.0, (Parameters.a_small, Parameters.kappa)),
        ("N-B", INCOMPRESSIBLE, 0.0, CORNERS),
        ("fixed", INCOMPRESSIBLE, 0.0, CORNERS),
        ("N-B", TRUCK, 0.0, (Parameters.mesh_force, Parameters.sync_impulse)),
        ("N-B", {}, 3e-7, (Parameters.leak_atm, Parameters.f_run_s)),
    ],
    ids=["compressible", "incompressible", "incompressible fixed", "truck", "leak"],
)
def test_what_the_lanes_do_not_cover_has_derivatives_too(
    kind: str, conditions: dict, leak: float, places: tuple[int, ...]
) -> None:
    base = setup(kind, **conditions)
    base.p.leak_atm = leak
    size, columns = SIZE[kind], COLUMNS[kind]

    def neighbour(place: int, share: float) -> Setup:
        twin = base.copy()
        twin.p[place] *= 1.0 + share
        return twin

    predictor = Predictor(np.rint(TIME_S * 1e9).astype(np.int64))
    neighbours = [neighbour(place, MOVE) for place in places]
    steps = [MOVE * base.p[place] for place in places]
    _, slopes = predictor.derivatives(base, neighbours, steps, columns, tolerance=1e-7)
    exact = Predictor(predictor.sample_ns, 1e-11)
    for place, ours in zip(places, slopes, strict=True):
        assert ours is not None
        up, down = (exact.states(neighbour(place, share))[:, columns] for share in (1e-5, -1e-5))
        true = (up - down) / (2e-5 * base.p[place])
        limit = 2e-4 if places is CORNERS else 1e-3
        assert np.linalg.norm((ours - true) / size) < limit * np.linalg.norm(true / size)


def test_as_many_steps_as_neighbours() -> None:
    base = setup("fixed")
    predictor = Predictor(np.rint(TIME_S * 1e9).astype(np.int64))
    with pytest.raises(ValueError, match="steps"):
        predictor.derivatives(base, [base.copy()], [])
