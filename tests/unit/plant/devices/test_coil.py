"""Valve with its coil: delays, thresholds, energy, and independence of the grants of time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from can_dbc.errors import InputError
from plant.devices.coil import CoilValve, Solenoid, SolenoidState
from plant.devices.valve import CoilConfig, SupplyDip, Valve, ValveTiming
from plant.devices.valve_faults import ValveFault
from plant.node import PlantConfig, PlantNode
from plant.parameters import load

MS = 1_000_000
TIMING = ValveTiming(8 * MS, 35 * MS, 0.33, 0.35)


def valve(**changes: object) -> CoilValve:
    return CoilValve(TIMING, msgspec.structs.replace(CoilConfig(), **changes))


def delays_ms(on: float = 0.98, hold: float | None = None, **changes: float) -> tuple[float, float]:
    """Opening and closing delay for a push of 500 ms, held at `hold` for the second half of it."""
    one = valve(**changes)
    one.command(0, on)
    one.command(250 * MS, on if hold is None else hold)
    one.command(500 * MS, 0.0)
    (opened, _), (closed, _) = one.moves(700 * MS)
    return opened / MS, closed / MS - 500.0


def magnetic_j(solenoid: Solenoid, state: SolenoidState) -> float:
    x = state.position_m
    inductance = solenoid.inductance_h + solenoid.inductance_slope_h_m * x
    inductance += 0.5 * solenoid.inductance_curve_h_m2 * x * x
    return 0.5 * inductance * state.current_a**2


def mechanical_j(solenoid: Solenoid, state: SolenoidState) -> float:
    x = state.position_m
    spring = solenoid.preload_n * x + 0.5 * solenoid.stiffness_n_m * x * x
    return spring + 0.5 * solenoid.mass_kg * state.velocity_m_s**2


def test_opens_after_8_ms_and_closes_after_35_ms() -> None:
    opening, closing = delays_ms()
    assert opening == pytest.approx(8.0, abs=0.3)
    assert closing == pytest.approx(35.0, abs=0.3)


def test_small_holding_duty_closes_in_6_ms() -> None:
    assert delays_ms(hold=0.36)[1] == pytest.approx(6.0, abs=0.3)


def test_thresholds_come_out_where_the_delays_have_them() -> None:
    """At rest both models agree for every duty but those between the thresholds of the delays."""
    for percent in (*range(0, 33, 8), 33, 35, *range(36, 101, 16)):
        for was_open in (False, True):
            both = []
            for kind in (
                Valve(TIMING, was_open, 0.98 * was_open),
                CoilValve(TIMING, CoilConfig(), was_open, 0.98 * was_open),
            ):
                kind.command(0, percent / 100)
                kind.moves(1000 * MS)
                both.append(kind.is_open)
            assert both[0] == both[1], (percent, was_open)


def test_carrier_phase_moves_the_opening_by_less_than_a_period() -> None:
    opening = [delays_ms(on=0.6, carrier_phase=phase)[0] for phase in (0.0, 0.25, 0.5, 0.75)]
    assert 0.05 < max(opening) - min(opening) < 1.0


def test_dip_of_the_supply_delays_the_opening() -> None:
    dip = SupplyDip(start_s=0.002, end_s=0.010, supply_v=8.0)
    assert delays_ms(dip=[dip])[0] > delays_ms()[0] + 3.0
    before = SupplyDip(start_s=0.0, end_s=0.002, supply_v=8.0)
    later = [before, SupplyDip(start_s=0.6, end_s=0.7, supply_v=8.0)]
    assert delays_ms(dip=later) == delays_ms(dip=[before])
    long = SupplyDip(start_s=0.1, end_s=0.4, supply_v=5.0)  # less than what holds the plunger
    assert len(_moves_with(long)) == 4 and len(_moves_with(dip)) == 2


def _moves_with(dip: SupplyDip) -> list[tuple[int, float]]:
    one = valve(dip=[dip])
    one.command(0, 0.98)
    one.command(500 * MS, 0.0)
    return one.moves(700 * MS)


def test_dips_that_overlap_or_end_before_they_start_are_refused() -> None:
    dips = [SupplyDip(start_s=a, end_s=a + 0.2, supply_v=8.0) for a in (0.3, 0.2)]
    with pytest.raises(InputError, match=r"coil.dip: one from 0.3 s within that to 0.4 s"):
        valve(dip=dips)
    with pytest.raises(ValueError, match="end_s"):
        SupplyDip(start_s=0.3, end_s=0.3, supply_v=8.0)


def test_supply_temperature_and_decay_change_the_delays() -> None:
    opening, closing = delays_ms()
    assert delays_ms(supply_v=18.0)[0] > opening + 2.0
    assert delays_ms(temperature_k=393.15)[0] > opening + 1.0
    assert delays_ms(decay_v=40.0)[1] < 0.3 * closing
    assert delays_ms(carrier_hz=5000.0)[0] == pytest.approx(opening, abs=0.2)


def test_pulse_too_short_to_move_the_plunger_leaves_no_trace() -> None:
    one = valve()
    one.command(0, 0.98)
    one.command(5 * MS, 0.0)
    assert one.moves(200 * MS) == []
    assert one.state.position_m == 0.0 and one.state.supplied_j > 0.01


def test_current_settles_at_the_mean_of_the_voltage() -> None:
    one = valve()
    one.command(0, 0.6)
    currents = []
    for t_ns in range(400 * MS, 401 * MS, 20_000):
        one.moves(t_ns)
        currents.append(one.state.current_a)
    expected = (0.6 * (24.0 + one.solenoid.decay_v) - one.solenoid.decay_v) / 24.0
    assert np.mean(currents) == pytest.approx(expected, rel=1e-3)


def test_supplied_energy_is_heat_field_spring_motion_and_friction() -> None:
    one = valve()
    ends = {}
    for t_ns, duty in ((0, 0.98), (100 * MS, 0.36), (200 * MS, 0.0), (400 * MS, 0.0)):
        one.command(t_ns, duty)
        ends[t_ns] = one.state
    solenoid = one.solenoid
    for state in ends.values():
        stored = magnetic_j(solenoid, state) + mechanical_j(solenoid, state)
        spent = state.heat_j + state.friction_j
        assert stored + spent == pytest.approx(state.supplied_j, abs=2e-5)
    assert ends[100 * MS].friction_j > 1e-4  # the plunger did meet its stop
    assert mechanical_j(solenoid, ends[100 * MS]) > 0.005
    assert ends[400 * MS].heat_j > 1.0


def test_opening_agrees_with_an_independent_solver() -> None:
    """Full duty, so that the voltage is constant; flux, position and velocity by scipy."""
    s = valve().solenoid

    def inductance(x: float) -> float:
        return s.inductance_h + s.inductance_slope_h_m * x + 0.5 * s.inductance_curve_h_m2 * x * x

    def rates(_t: float, y: np.ndarray) -> list[float]:
        flux, x, v = y
        i = flux / inductance(x)
        force = 0.5 * i * i * (s.inductance_slope_h_m + s.inductance_curve_h_m2 * x)
        force -= s.preload_n + s.stiffness_n_m * x + s.damping_n_s_m * v
        resting = x <= 0.0 and force < 0.0
        return [s.supply_v - s.resistance_ohm * i, v, 0.0 if resting else force / s.mass_kg]

    def crosses(_t: float, y: np.ndarray) -> float:
        return float(y[1] - 0.55 * s.travel_m)

    crosses.terminal = True  # type: ignore[attr-defined]
    results = solve_ivp(rates, (0, 0.03), [0.0, 0.0, 0.0], events=crosses, rtol=1e-9, atol=1e-12)
    assert delays_ms(on=1.0)[0] == pytest.approx(results.t_events[0][0] * 1e3, abs=0.005)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 150 * MS), max_size=12))
def test_moves_do_not_depend_on_the_grants(grants: list[int]) -> None:
    dip = SupplyDip(start_s=0.0123, end_s=0.0163, supply_v=15.0)

    def moves(instants: list[int]) -> list[tuple[int, float]]:
        one = valve(dip=[dip])
        results = []
        commands = {10 * MS: 0.98, 60 * MS + 123: 0.0}
        for t_ns in sorted({*instants, *commands}):
            results += one.moves(t_ns)
            if t_ns in commands:
                one.command(t_ns, commands[t_ns])
        return results + one.moves(150 * MS)

    assert moves(grants) == moves([])
    assert [u for _, u in moves(grants)] == [1.0, 0.0]


def test_noted_currents_do_not_change_the_motion() -> None:
    results = []
    for sample_ns in (0, 333_333):
        one = CoilValve(TIMING, CoilConfig(), sample_ns=sample_ns)
        one.command(10 * MS + 1, 0.98)
        one.command(60 * MS + 123, 0.0)
        results.append((one.moves(150 * MS), one.state))
    assert results[0] == results[1]
    assert [at for at, _ in one.currents] == list(range(0, 150 * MS + 1, 333_333))
    assert max(current for _, current in one.currents) > 0.7


def test_blocked_plunger_does_not_move() -> None:
    one = valve()
    one.block(0)
    one.command(0, 0.98)
    assert one.moves(100 * MS) == [] and one.state.current_a > 0.9
    one.free(100 * MS)
    ((opened, _),) = one.moves(200 * MS)
    assert 100 * MS < opened < 105 * MS


@pytest.mark.parametrize(
    "changes",
    [{"closing_follows_duty": True}, {"valve_faults": (ValveFault(kind="slow", valve="B"),)}],
)
def test_settings_of_the_delays_are_refused(changes: dict[str, object]) -> None:
    config = msgspec.structs.replace(PlantConfig(drive="coil"), **changes)
    with pytest.raises(InputError, match="coil"):
        PlantNode(config, load())
