"""The length stroke over whole shifts, in faults, in pieces and at random: physical, and always an end."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from plant.errors import InputError
from plant.integrator.hybrid import Event
from plant.kernel.layout import FixedState, LengthState
from plant.parameters import ParameterSet
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import MS, NOMINAL
from tests.physics.strokes import length_stroke

STROKE, FREE = 0.01285, 0.013
LOADS = {
    "free": {},
    "truck": {
        "mounted": True,
        "mesh_force_n": 800.0,
        "pull_force_n": 500.0,
        "sync_impulse_n_s": 18.0,
    },
    "damper": {"damper": "compressible"},
    "algebraic damper": {"damper": "incompressible"},
}


def within(actuator: LengthStroke, y: np.ndarray) -> None:
    """No stop is passed, no pressure negative, the balances close, the events are few."""
    assert np.abs(y[:, LengthState.x_s]).max() <= STROKE + 1e-9
    for piston, side in ((LengthState.x_1, -1.0), (LengthState.x_2, 1.0)):
        assert y[:, piston].min() >= -1e-9
        gap = y[:, piston] + side * y[:, LengthState.x_s]
        assert gap.min() >= -1e-9 and gap.max() <= FREE + 1e-9
    assert y[:, [LengthState.p_b, LengthState.p_n, LengthState.p_f]].min() > 5e4
    assert actuator.balance().closed
    assert len(actuator.events) < 400


def run(
    actuator: LengthStroke, until_ms: int, switches: list[tuple[int, int, float]]
) -> np.ndarray:
    """Advance in pieces of 10 ms as under lockstep; states every 0.2 ms."""
    rows = []
    for end in range(actuator.now_ns + 10 * MS, until_ms * MS + 1, 10 * MS):
        start = actuator.now_ns
        inside = [s for s in switches if start < s[0] <= end]
        wanted = np.arange(start + MS // 5, end + 1, MS // 5, dtype=np.int64)
        rows.append(actuator.advance(end, inside, wanted))
    return np.concatenate(rows)


@pytest.mark.parametrize("load", sorted(LOADS))
@pytest.mark.parametrize(("start", "first", "last"), [("B", 1, 2), ("F", 1, 0)])
def test_full_shift_through_neutral(load: str, start: str, first: int, last: int) -> None:
    actuator = length_stroke(NOMINAL, initial=start, **LOADS[load])
    switches = [
        (10 * MS, first, 1.0),
        (300 * MS, first, 0.0),
        (320 * MS, last, 1.0),
        (700 * MS, last, 0.0),
    ]
    y = run(actuator, 1300, switches)
    within(actuator, y)
    side = 1.0 if last == 0 else -1.0
    assert y[1480, LengthState.x_s] == pytest.approx(0.0, abs=1e-9)  # in neutral at 296 ms
    assert actuator.position_m == pytest.approx(side * STROKE, abs=1e-9)
    stops = [e for e in actuator.events if e.name == "stop" and e.speed_m_s > 0.05]
    assert [round(stop.position_m / STROKE) for stop in stops][:1] == [0]
    assert round(stops[-1].position_m / STROKE) == side
    assert actuator.pressures_pa == pytest.approx((101325.0,) * 3, rel=0.02)


@pytest.mark.parametrize("start", ["B", "N", "F"])
@pytest.mark.parametrize("load", sorted(LOADS))
def test_both_engaging_chambers_charged(load: str, start: str) -> None:
    actuator = length_stroke(NOMINAL, initial=start, **LOADS[load])
    y = run(actuator, 500, [(10 * MS, 0, 1.0), (15 * MS, 2, 1.0), (400 * MS, 0, 0.0)])
    within(actuator, y)
    # B and F push against each other: until B is vented nothing reaches the other end
    if start == "N":
        assert np.abs(y[:1900, LengthState.x_s]).max() < STROKE


def test_venting_neutral_in_the_middle_of_the_motion_and_charging_it_again() -> None:
    actuator = length_stroke(NOMINAL, initial="B", mounted=True, pull_force_n=900.0)
    y = run(
        actuator, 500, [(10 * MS, 1, 1.0), (45 * MS, 1, 0.0), (90 * MS, 1, 1.0), (400 * MS, 1, 0.0)]
    )
    within(actuator, y)
    assert actuator.position_m == pytest.approx(0.0, abs=1e-9)


def test_the_starting_place_and_the_properties() -> None:
    actuator = LengthStroke(NOMINAL, initial="F", charged=("F",), supply_pressure_pa=6e5)
    assert actuator.position_m == -STROKE
    assert actuator.pistons_m == (0.0, pytest.approx(STROKE + FREE))
    assert actuator.pressures_pa == (101325.0, 101325.0, 6e5)
    row = dict(zip(actuator.columns, actuator.row(), strict=True))
    assert row["position_m"] == -STROKE and row["pressure_F_pa"] == 6e5
    with pytest.raises(InputError, match="initial gear 'R'"):
        LengthStroke(NOMINAL, initial="R")


END = 300 * MS
SWITCHES = [(18 * MS, 0, 1.0), (235 * MS, 0, 0.0)]
PIECE_LOADS = [
    {},
    {"mounted": True, "mesh_force_n": 800.0, "sync_impulse_n_s": 14.0},
    {"damper": "compressible"},
]


def pieces(bounds: list[int], load: dict[str, object], samples: int = 0) -> LengthStroke:
    """The same N-B shift, advanced from bound to bound."""
    actuator = length_stroke(NOMINAL, **load)
    before = 0
    for bound in bounds:
        inside = [s for s in SWITCHES if before < s[0] <= bound]
        wanted = None
        if samples:
            wanted = np.linspace(before + 1, bound, samples).astype(np.int64)
        actuator.advance(bound, inside, wanted)
        before = bound
    return actuator


def reported(actuator: LengthStroke) -> list[Event]:
    """Its events without those of the oil, which empties asymptotically and fills at any touch."""
    return [event for event in actuator.events if not event.name.startswith("oil")]


@pytest.mark.parametrize("load", PIECE_LOADS, ids=["free", "truck", "damper"])
@pytest.mark.parametrize("period", [10 * MS, 2_500_000, 333_333])
def test_pieces_give_the_same_events(load: dict[str, object], period: int) -> None:
    whole = pieces([END], load)
    parts = pieces([*range(period, END, period), END], load)
    assert [e.name for e in reported(parts)] == [e.name for e in reported(whole)]
    assert len(reported(whole)) > 3
    for a, b in zip(reported(parts), reported(whole), strict=True):
        assert a.time_s == pytest.approx(b.time_s, abs=1e-8)
        assert a.speed_m_s == pytest.approx(b.speed_m_s, rel=3e-6)
    assert parts.balance().closed


@pytest.mark.parametrize("load", PIECE_LOADS, ids=["free", "truck", "damper"])
def test_a_sample_request_does_not_change_the_motion(load: dict[str, object]) -> None:
    bounds = [*range(10 * MS, END, 10 * MS), END]
    unseen, seen = pieces(bounds, load), pieces(bounds, load, samples=97)
    assert seen.row().tobytes() == unseen.row().tobytes()
    assert seen.events == unseen.events


def test_switches_and_instants_out_of_order_are_refused() -> None:
    actuator = LengthStroke(NOMINAL)
    actuator.advance(10 * MS)
    with pytest.raises(ValueError, match="back"):
        actuator.advance(9 * MS)
    for switches in (
        [(9 * MS, 0, 1.0)],
        [(21 * MS, 0, 1.0)],
        [(15 * MS, 0, 1.0), (12 * MS, 0, 0.0)],
    ):
        with pytest.raises(ValueError, match="out of order"):
            actuator.advance(20 * MS, switches)


@pytest.mark.parametrize("instant", [50 * MS, 50 * MS + 1])
def test_a_switch_at_the_end_of_a_piece_acts_from_there_on(instant: int) -> None:
    split = LengthStroke(NOMINAL)
    split.advance(instant, [(instant, 0, 1.0)])
    split.advance(END)
    whole = LengthStroke(NOMINAL)
    whole.advance(END, [(instant, 0, 1.0)])
    assert split.row() == pytest.approx(whole.row(), rel=1e-9, abs=1e-9)


END_S = 0.25
FRICTIONS = ("F_sf_s", "F_sf_p", "F_rf_s", "F_rf_p", "beta_s", "beta_p")
# The balances close to the integrator's accuracy, not to rounding.
CLOSED = 1e-5

factor = st.floats(math.log(0.3), math.log(3.0)).map(math.exp)
milliseconds = st.integers(0, 200)


@st.composite
def length_parameters(draw: st.DrawFn) -> dict[str, float]:
    """Changes of the length stroke's numbers."""
    value = NOMINAL.value
    changes = {
        f"friction_length.{n}": value(f"friction_length.{n}") * draw(factor) for n in FRICTIONS
    }
    for name in ("length.m_s", "length.m_p", "length.A_s", "length.V_B0", "length.V_F0"):
        changes[name] = value(name) * draw(factor)
    area = value("length.A_p") * draw(factor)
    changes["length.A_p"] = area
    # what is left of N with both pistons at their collars
    changes["length.V_N0"] = 2.0 * area * value("length.x_free_total") + 2.8e-5 * draw(factor)
    # what is left of F with the stay backward, of B with it forward
    for name in ("length.V_B0", "length.V_F0"):
        changes[name] += changes["length.A_s"] * value("length.stroke")
    changes["stops.restitution"] = draw(st.sampled_from([0.0, 0.0, 0.2, 0.5, 0.8]))
    return changes


@st.composite
def fixed_parameters(draw: st.DrawFn) -> dict[str, float]:
    """Changes of the fixed piston's numbers."""
    value = NOMINAL.value
    names = ("fixed.m_s", "fixed.m_p", "fixed.V10", "friction_fixed.F_sf", "friction_fixed.F_rf")
    changes = {name: value(name) * draw(factor) for name in names}
    changes["friction_fixed.beta"] = value("friction_fixed.beta") * draw(factor)
    size = draw(factor)
    changes["fixed.A1"] = value("fixed.A1") * size
    changes["fixed.A2"] = value("fixed.A2") * size
    sweep = changes["fixed.A2"] * value("fixed.stroke")
    changes["fixed.V20"] = sweep + 3.4e-5 * draw(factor)
    changes["stops.restitution"] = draw(st.sampled_from([0.0, 0.0, 0.2, 0.5, 0.8]))
    return changes


def flows(parameters: ParameterSet, charge: float, discharge: float) -> ParameterSet:
    """The set with its flow maps scaled."""
    changes = {}
    for path, by in (("flow_charge", charge), ("flow_discharge", discharge)):
        for part in ("c_low", "c_high"):
            name = f"{path}.{part}"
            changes[name] = [by * c for c in parameters.values(name)]
    return parameters.override(changes)


def sequence(chambers: int) -> st.SearchStrategy[list[tuple[int, int, float]]]:
    """Valve positions at whole milliseconds, several valves at once included."""
    one = st.tuples(milliseconds, st.integers(0, chambers - 1), st.sampled_from([0.0, 1.0]))
    return st.lists(one, min_size=1, max_size=8).map(
        lambda moves: sorted((t * MS, c, u) for t, c, u in moves)
    )


def check_balances(system: Any) -> None:
    """Energy and gas accounted for; friction, damper and impacts only take."""
    balance = system.balance() if callable(system.balance) else system.balance
    assert abs(balance.energy_residual_j) <= CLOSED * max(balance.energy_scale_j, 1.0)
    for residual in balance.gas_residual_j:
        assert abs(residual) <= CLOSED * max(balance.gas_scale_j, 1.0)
    assert balance.friction_j >= -1e-6 and balance.impact_j >= -1e-9


def check_length(changes: dict[str, float], load: dict[str, Any], moves: Any, start: str) -> None:
    """Run a length stroke and look at everything that must hold."""
    parameters = flows(NOMINAL, load.pop("charge", 1.0), load.pop("discharge", 1.0))
    actuator = length_stroke(parameters.override(changes), initial=start, **load)
    wanted = np.arange(MS // 4, round(END_S * 1e9) + 1, MS // 4, dtype=np.int64)
    y = actuator.advance(round(END_S * 1e9), moves, wanted)
    stroke, free = NOMINAL.value("length.stroke"), NOMINAL.value("length.x_free_total")
    assert np.isfinite(y).all()
    assert np.abs(y[:, LengthState.x_s]).max() <= stroke + 1e-9
    assert y[:, [LengthState.x_1, LengthState.x_2]].min() >= -1e-9
    for piston, side in ((LengthState.x_1, -1.0), (LengthState.x_2, 1.0)):
        gap = y[:, piston] + side * y[:, LengthState.x_s]
        assert gap.min() >= -1e-9 and gap.max() <= free + 1e-9
    assert y[:, [LengthState.p_b, LengthState.p_n, LengthState.p_f]].min() > 0.0
    assert y[:, LengthState.p_oil].min() > 0.0
    check_balances(actuator)
    assert len(actuator.events) < 1000


DRAWN_LOADS = st.fixed_dictionaries(
    {
        "mounted": st.booleans(),
        "damper": st.sampled_from(["none", "none", "incompressible", "compressible"]),
        "mesh_force_n": st.floats(0.0, 1300.0),
        "pull_force_n": st.floats(0.0, 1100.0),
        "sync_impulse_n_s": st.sampled_from([0.0, 0.0, 2.0, 18.0, 78.0]),
        "supply_pressure_pa": st.floats(2e5, 1e6),
        "charged": st.sets(st.sampled_from("BNF")).map(sorted),
        "charge": factor,
        "discharge": factor,
    }
)


@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(length_parameters(), DRAWN_LOADS, sequence(3), st.sampled_from("BNF"))
# both pistons leave the stay at a stop from which it bounces
@example(
    {"length.m_s": 0.527, "length.m_p": 0.487, "length.A_p": 0.00156, "length.V_N0": 4.93e-5,
     "friction_length.F_sf_p": 93.0, "stops.restitution": 0.579},
    {"supply_pressure_pa": 483715.0, "charged": ["F"]},
    [(18 * MS, 1, 1.0)],
    "B",
)  # fmt: skip
# light pistons on either side of a heavy stay: contacts that part slower than rounding
@example(
    {"length.m_s": 2.215, "length.m_p": 0.0654, "friction_length.F_sf_p": 118.2},
    {"supply_pressure_pa": 680909.0, "mounted": True, "pull_force_n": 157.3},
    [(17 * MS, 2, 1.0), (18 * MS, 1, 1.0), (167 * MS, 1, 0.0)],
    "B",
)
# stay and piston break away together and then slide apart
@example(
    {"length.m_s": 0.358, "length.A_p": 0.001579, "length.A_s": 0.000546, "length.V_B0": 1.1e-5,
     "friction_length.F_sf_p": 107.4, "friction_length.F_rf_s": 28.3,
     "friction_length.F_rf_p": 13.1},
    {"supply_pressure_pa": 485497.0},
    [(18 * MS, 0, 1.0)],
    "N",
)  # fmt: skip
# two pistons part at once from the stay that they held between them, while it still creeps
@example(
    {"length.A_p": 0.006831787370332398, "length.V_B0": 3.203694655525e-05,
     "length.V_F0": 3.203694655525e-05, "length.V_N0": 0.00020562647162864235},
    {"supply_pressure_pa": 521368.0, "charged": ["B", "F"]},
    [(2 * MS, 0, 0.0)],
    "N",
)  # fmt: skip
# a piston that grazes its collar within one long step
@example(
    {"friction_length.F_sf_s": 11.404262676314712, "friction_length.F_rf_p": 60.94481297197652,
     "friction_length.beta_s": 8.256308508374639, "friction_length.beta_p": 10.991473351478225,
     "length.A_s": 0.0007991061741216949, "length.V_B0": 7.743702256854252e-05,
     "length.V_F0": 2.0569138690264164e-05, "length.A_p": 0.0028479126812108895,
     "length.V_N0": 0.00010204572971148312},
    {"supply_pressure_pa": 323495.0, "charged": ["B", "F", "N"]},
    [(0, 0, 0.0)],
    "B",
)  # fmt: skip
# stick-slip between closed chambers, hundreds of events
@example(
    {"friction_length.F_sf_p": 65.94885082800513, "length.A_s": 0.0008539734212915498,
     "length.V_B0": 3.897355846359641e-05, "length.V_F0": 2.12741828163968e-05,
     "length.A_p": 0.007532617442911611, "length.V_N0": 0.0002238480535157019},
    {"supply_pressure_pa": 563744.0, "charged": ["B", "F", "N"]},
    [(0, 1, 0.0)],
    "N",
)  # fmt: skip
def test_length_stroke_stays_physical(
    changes: dict[str, float], load: dict[str, Any], moves: Any, start: str
) -> None:
    check_length(changes, dict(load), moves, start)


FIXED_LOADS = st.one_of(
    st.just({}),
    st.fixed_dictionaries(
        {
            "load": st.just("damper"),
            "damper_model": st.sampled_from(["compressible", "incompressible"]),
        }
    ),
    st.fixed_dictionaries(
        {
            "load": st.just("spring"),
            "spring_n_per_m": st.floats(1e3, 2e5),
            "start_offset_m": st.floats(0.0, 0.0128),
        }
    ),
)
COMMANDS = st.lists(
    st.tuples(
        milliseconds.map(lambda t: t / 1000.0), st.sampled_from("12"), st.sampled_from([0.0, 0.98])
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    fixed_parameters(), FIXED_LOADS, COMMANDS, st.floats(2e5, 1e6), st.sets(st.sampled_from("12"))
)
def test_fixed_piston_stays_physical(
    changes: dict[str, float],
    load: dict[str, Any],
    commands: list[tuple[float, str, float]],
    supply: float,
    charged: set[str],
) -> None:
    conditions = StrokeConditions(
        "fixed", supply, tuple(sorted(commands)), charged_before=tuple(sorted(charged)), **load
    )
    times = np.arange(0, 1001) * (END_S / 1000)
    stroke = simulate(NOMINAL.override(changes), conditions, times, internal=False)
    y = stroke.states
    assert np.isfinite(y).all()
    assert (
        y[:, FixedState.x].min() >= -1e-9
        and y[:, FixedState.x].max() <= NOMINAL.value("fixed.stroke") + 1e-9
    )
    assert y[:, [FixedState.p_1, FixedState.p_2, FixedState.p_oil]].min() > 0.0
    check_balances(stroke)
    assert len(stroke.events) < 1000


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(length_parameters(), sequence(3), st.sampled_from("BNF"))
def test_a_shut_and_unpowered_stroke_gains_no_energy(
    changes: dict[str, float], moves: Any, start: str
) -> None:
    # no supply above the atmosphere: nothing may ever move
    actuator = LengthStroke(NOMINAL.override(changes), initial=start, supply_pressure_pa=101325.0)
    before = actuator.row()
    actuator.advance(round(END_S * 1e9), moves)
    still = [
        LengthState.x_s, LengthState.x_1, LengthState.x_2, LengthState.v_s, LengthState.v_1,
        LengthState.v_2,
    ]  # fmt: skip
    assert actuator.row()[still].tolist() == before[still].tolist()
