"""The batch: lanes against the scalar kernel, routing, refusals; derivatives along a frozen sequence of steps."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from plant.batch.batch import BatchResult, Strokes, simulate_batch
from plant.batch.prediction import MOVE, Followers, Predictor
from plant.effects import CATALOGUE
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.integrator.loop import DONE
from plant.kernel.layout import EventRow, FixedState, Guard, LengthState, Parameters
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup
from tests.varied_strokes import varied_strokes

STROKES = {
    "fixed": (((0.01, "1", 0.98),), ()),
    "N-B": (((0.01, "B", 0.98), (0.01, "N", 0.0)), ("N",)),
    "B-N": (((0.01, "N", 0.98), (0.01, "B", 0.0)), ("B",)),
    "N-F": (((0.01, "F", 0.98), (0.03, "N", 0.0)), ("N",)),
    "F-N": (((0.01, "N", 0.98), (0.05, "F", 0.0)), ("F",)),
}
DURATION_S = 0.25
EQUAL = ("status", "arrival_s", "impact_speed_m_s", "final", "samples", "events", "steps")


def setup(kind: str = "fixed", **more: object) -> Setup:
    commands, charged = STROKES[kind]
    conditions = StrokeConditions(kind, 9e5, commands, charged_before=charged)
    return make_setup(load(), dataclasses.replace(conditions, **more))


def varied(kind: str, n: int = 20, **more: object) -> Strokes:
    rng = np.random.default_rng(3)
    return varied_strokes(
        setup(kind, **more),
        DURATION_S,
        {
            Parameters.p_supply: rng.uniform(6e5, 1e6, n),
            Parameters.m_s: rng.uniform(0.6, 9.0, n),
            Parameters.k_in: rng.uniform(0.7, 1.2, n),
            Parameters.k_out: rng.uniform(0.7, 1.2, n),
            Parameters.vol_b: rng.uniform(2e-5, 6e-5, n),
            Parameters.f_run_s: rng.uniform(5.0, 80.0, n),
        },
    )


def same(first: BatchResult, second: BatchResult, rows: object = slice(None)) -> bool:
    return all(
        np.array_equal(getattr(first, name)[rows], getattr(second, name), equal_nan=True)
        for name in EQUAL
    )


def test_a_short_supply_line_at_rest_takes_few_steps() -> None:
    lines = []
    for cda_m2, volume_m3 in ((1.3e-5, 1e-5), (8e-6, 4e-4)):
        line = setup("N-B")
        CATALOGUE["hose_droop"].apply(line, {"cda_m2": cda_m2, "volume_m3": volume_m3})
        lines.append(line)
    how = {"sample_s": np.linspace(0.0, 2.0, 201)}
    rough, exact = (
        simulate_batch(Strokes.from_setups(lines, 2.0), tolerance=tolerance, **how)
        for tolerance in (1e-5, 1e-9)
    )
    assert (rough.status == DONE).all() and (exact.status == DONE).all()
    assert (rough.steps < 400).all()  # the explicit method takes 11,000
    assert rough.arrival_s == pytest.approx(exact.arrival_s, abs=2e-6)
    pressures = slice(LengthState.p_b, LengthState.p_f + 1)
    assert rough.final[:, pressures] == pytest.approx(exact.final[:, pressures], rel=1e-4)
    assert exact.final[:, LengthState.p_b] == pytest.approx(9e5, rel=1e-4)


@pytest.mark.parametrize("kind", STROKES)
def test_lanes_agree_with_the_scalar_kernel(kind):
    strokes = varied(kind)
    sample_s = np.linspace(0.0, DURATION_S, 51)
    fast = simulate_batch(strokes, sample_s=sample_s, tolerance=1e-9)
    slow = simulate_batch(strokes, sample_s=sample_s, tolerance=1e-9, lanes=False)
    assert fast.in_lanes.all() and not slow.in_lanes.any()
    assert (fast.status == DONE).all() and (slow.status == DONE).all()
    assert np.isfinite(slow.arrival_s).sum() >= 15
    assert np.array_equal(np.isnan(fast.arrival_s), np.isnan(slow.arrival_s))
    assert np.nanmax(np.abs(fast.arrival_s - slow.arrival_s)) < 2e-7
    assert np.nanmax(np.abs(fast.impact_speed_m_s - slow.impact_speed_m_s)) < 1e-5
    first = FixedState.p_1 if kind == "fixed" else LengthState.p_b
    moving = slice(first, first + (2 if kind == "fixed" else 3))
    assert np.abs(fast.samples[:, :, moving] - slow.samples[:, :, moving]).max() < 20.0
    assert np.abs(fast.samples[:, :, 0] - slow.samples[:, :, 0]).max() < 1e-7
    assert np.abs(fast.final - slow.final).max() < 1.0


@pytest.mark.parametrize("kind", ["N-B", "F-N", "N-F"])
def test_barriers_and_the_synchronizer_are_those_of_the_scalar_kernel(kind):
    n, rng = 40, np.random.default_rng(6)
    loads = {
        Parameters.mesh_force: rng.uniform(0.0, 1200.0, n),
        Parameters.pull_force: rng.uniform(0.0, 700.0, n),
        Parameters.sync_impulse: rng.uniform(0.0, 60.0, n) * (rng.random(n) < 0.7),
    }
    strokes = varied_strokes(setup(kind, mounted=True), DURATION_S, loads)
    how = {"sample_s": np.linspace(0.0, DURATION_S, 51), "tolerance": 1e-9, "event_room": 40}
    fast = simulate_batch(strokes, **how)
    slow = simulate_batch(strokes, lanes=False, **how)
    assert fast.in_lanes.all() and not slow.in_lanes.any()
    assert (fast.status == DONE).all() and (slow.status == DONE).all()
    assert np.abs(fast.samples[:, :, 0] - slow.samples[:, :, 0]).max() < 1e-7
    assert np.abs(fast.final - slow.final).max() < 1.0
    assert fast.final[:, LengthState.impulse] == pytest.approx(
        slow.final[:, LengthState.impulse], abs=1e-6
    )
    guards = fast.events[:, :, EventRow.guard][fast.events[:, :, EventRow.time] > 0.0]
    assert (guards == Guard.UNBLOCK).any() == (kind != "F-N")


def test_events_and_states_are_those_of_a_single_simulation():
    base = setup("fixed")
    stroke = run_setup(base, np.linspace(0.0, DURATION_S, 101))
    batch = simulate_batch(
        Strokes.from_setups([base], DURATION_S),
        sample_s=np.linspace(0.0, DURATION_S, 101),
        tolerance=1e-8,
        event_room=8,
    )
    times = [event.time_s for event in stroke.events]
    assert batch.event_count[0] == len(times) == 2
    assert batch.events[0, :2, EventRow.time] == pytest.approx(times, abs=1e-8)
    assert batch.arrival_s[0] == pytest.approx(stroke.impact.time_s, abs=1e-8)
    assert batch.impact_energy_j[0] == pytest.approx(stroke.impact.energy_j, rel=1e-6)
    assert np.abs(batch.samples[0, :, 0] - stroke.states[:, 0]).max() < 1e-8
    assert np.abs(batch.samples[0, :, 2:4] - stroke.states[:, 2:4]).max() < 1.0


@pytest.mark.parametrize("kind", ["fixed", "N-B"])
def test_neighbours_and_workers_do_not_matter(kind):
    strokes = varied(kind, 37)
    options = {"sample_s": np.linspace(0.0, DURATION_S, 11), "event_room": 6}
    whole = simulate_batch(strokes, **options)
    for workers in (2, 3):
        assert same(whole, simulate_batch(strokes, workers=workers, **options))
    for rows in ([5], [36, 2, 17]):
        part = dataclasses.replace(
            strokes, packed=strokes.packed[rows], initial=strokes.initial[rows]
        )
        assert same(whole, simulate_batch(part, **options), rows)


def test_what_the_lanes_do_not_cover_takes_the_scalar_kernel():
    plain = varied("fixed", 12)
    packed = plain.packed.copy()
    packed[1::3, Parameters.leak_piston] = 2e-8
    packed[2::3, Parameters.seal_mu] = 0.05
    mixed = simulate_batch(dataclasses.replace(plain, packed=packed), sample_s=np.array([0.1]))
    assert mixed.in_lanes.tolist() == [True, False, False] * 4
    only = simulate_batch(
        dataclasses.replace(plain, packed=packed), sample_s=np.array([0.1]), lanes=False
    )
    outside = ~mixed.in_lanes
    assert np.array_equal(mixed.final[outside], only.final[outside])
    pure = simulate_batch(plain, sample_s=np.array([0.1]))
    assert np.array_equal(mixed.final[::3], pure.final[::3])
    assert (np.abs(mixed.arrival_s - pure.arrival_s)[outside] > 1e-6).all()


@pytest.mark.parametrize("model", ["incompressible", "compressible"])
def test_damped_strokes_run_in_the_same_call(model):
    base = setup("fixed", load="damper", damper_model=model)
    batch = simulate_batch(Strokes.from_setups([base], DURATION_S), tolerance=1e-8)
    stroke = run_setup(base, np.linspace(0.0, DURATION_S, 11))
    assert not batch.in_lanes[0]
    assert batch.arrival_s[0] == pytest.approx(stroke.impact.time_s, abs=1e-7)
    assert batch.final[0, FixedState.p_1] == pytest.approx(
        stroke.states[-1, FixedState.p_1], abs=1.0
    )


def test_different_strokes_in_one_batch():
    setups = [
        setup("N-B"),
        setup("B-N"),
        setup("N-B", charged_before=(), commands=((0.02, "B", 0.98),)),
        setup("F-N", supply_pressure_pa=7e5),
    ]
    together = simulate_batch(Strokes.from_setups(setups, DURATION_S))
    for k, item in enumerate(setups):
        alone = simulate_batch(Strokes.from_setups([item], DURATION_S))
        assert np.array_equal(alone.final[0], together.final[k])
        assert np.array_equal(alone.arrival_s, together.arrival_s[k : k + 1], equal_nan=True)


def test_durations_columns_and_instants_of_each_stroke():
    base = varied("fixed", 3)
    strokes = dataclasses.replace(base, duration_s=np.array([0.05, 0.1, 0.25]))
    sample_s = np.array([[0.0, 0.02], [0.05, 0.1], [0.1, 0.3]])
    result = simulate_batch(strokes, sample_s=sample_s, columns=[FixedState.p_1, FixedState.p_line])
    assert result.samples.shape == (3, 2, 2)
    whole = simulate_batch(base, sample_s=np.unique(sample_s), columns=[FixedState.p_1])
    assert result.samples[0, :, 0] == pytest.approx(whole.samples[0, [0, 1], 0], rel=1e-6)
    assert result.samples[1, :, 0] == pytest.approx(whole.samples[1, [2, 3], 0], rel=1e-6)
    # beyond its end a stroke stands still
    assert result.samples[2, 1, 0] == result.final[2, FixedState.p_1]
    assert (result.samples[:, :, 1] == strokes.initial[:, None, FixedState.p_line]).all()


def test_creeping_valves_stay_in_the_lanes():
    base = setup("fixed")
    base.creep_s = 0.004
    strokes = Strokes.from_setups([base], DURATION_S)
    assert strokes.switches.shape[1] == 2 and strokes.in_lanes.all()
    fast = simulate_batch(strokes, tolerance=1e-9)
    slow = simulate_batch(strokes, tolerance=1e-9, lanes=False)
    assert fast.arrival_s[0] == pytest.approx(slow.arrival_s[0], abs=1e-8)
    sudden = simulate_batch(Strokes.from_setups([setup("fixed")], DURATION_S), tolerance=1e-9)
    assert fast.arrival_s[0] - sudden.arrival_s[0] > 5e-4


def test_a_stroke_that_cannot_go_on_does_not_stop_the_others():
    strokes = varied("fixed", 9)
    packed = strokes.packed.copy()
    packed[4, Parameters.vol_b] = np.nan
    result = simulate_batch(dataclasses.replace(strokes, packed=packed))
    assert result.status[4] != DONE
    others = np.arange(9) != 4
    assert (result.status[others] == DONE).all()
    assert np.array_equal(result.final[others], simulate_batch(strokes).final[others])


def test_refusals():
    strokes = varied("fixed", 3)
    with pytest.raises(ValueError, match="one system"):
        Strokes.from_setups([setup("fixed"), setup("N-B")], DURATION_S)
    times = np.array([[[0.02, 0.0, 1.0, 0.0], [0.01, 1.0, 1.0, 0.0]]])
    for match, wrong in (
        ("packed", {"packed": strokes.packed[:, :-1]}),
        ("initial", {"initial": strokes.initial[:2]}),
        ("ascend", {"switches": times}),
        ("duration_s", {"duration_s": np.array([0.0])}),
    ):
        with pytest.raises(ValueError, match=match):
            simulate_batch(dataclasses.replace(strokes, **wrong))
    with pytest.raises(ValueError, match="columns"):
        simulate_batch(strokes, sample_s=np.array([0.1]), columns=[8])
    with pytest.raises(ValueError, match="sample_s"):
        simulate_batch(strokes, sample_s=np.array([0.2, 0.1]))


@pytest.mark.parametrize("lanes", [True, False])
def test_a_piston_and_a_stay_that_stop_together_come_to_rest(lanes):
    # each turn of the piston joined it to a stay still slower: an endless sequence of turns
    strokes = varied_strokes(
        setup("N-B"),
        DURATION_S,
        {
            Parameters.p_supply: np.array([687342.237947325, 818301.9293072699]),
            Parameters.m_s: np.array([2.745923009162179, 2.940294823728706]),
            Parameters.vol_b: np.array([2.2092883797367875e-05, 3.037649213400499e-05]),
        },
    )
    result = simulate_batch(strokes, tolerance=1e-8, lanes=lanes)
    assert (result.status == DONE).all()
    assert (result.event_count < 20).all()


TIME_S = np.linspace(0.0, 0.25, 251)
FRICTION = {
    "fixed": (Parameters.f_static_s, Parameters.beta_s),
    "N-B": (Parameters.f_run_p, Parameters.beta_p),
}
MOVED = (
    Parameters.p_supply, Parameters.k_in, Parameters.k_out, Parameters.vol_b, Parameters.vol_n,
    Parameters.m_s, Parameters.f_run_s, Parameters.alpha_m1,
)  # fmt: skip
COLUMNS = {
    "fixed": (FixedState.x, FixedState.p_1, FixedState.p_2),
    "N-B": (LengthState.x_s, LengthState.p_b, LengthState.p_n, LengthState.p_f),
}
SIZE = {"fixed": (1e-3, 1e5, 1e5), "N-B": (1e-3, 1e5, 1e5, 1e5)}


def moved(base: Setup, places: tuple[int, ...], share: float) -> Strokes:
    """The stroke, then the stroke with each parameter moved by a share of itself."""
    rows = np.arange(len(places) + 1)
    changes = {i: base.p[i] * (1.0 + share * (rows == k + 1)) for k, i in enumerate(places)}
    return varied_strokes(base, TIME_S[-1], changes)


@pytest.mark.parametrize("kind", ["N-B", "fixed"])
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
