"""Plant node: a shift by frames, static schedule, exact instants, records, faults, determinism."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import decode
from can_dbc.e2e import E2eStatus, Protector, Receiver
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import (
    Chamber,
    DrivelineSpeeds,
    Gear,
    PlantMotion,
    PlantPressures,
    PositionPulse,
    SafetyBlow,
    ValveCommand,
)
from plant.devices.driveline import DrivelineConfig
from plant.devices.position_circuit import SensorConfig, SensorFault
from plant.devices.sensors import InductiveSensor
from plant.node import PlantConfig, PlantNode
from plant.parameters import load
from plant.systems.length_stroke import LengthStroke
from plant.trace import TRACE_COLUMNS

MS = 1_000_000
NOMINAL = load("nominal")
OFF = ValveCommand(0.0, 0.0, 0.0, Gear.NEUTRAL)
INTO_B = ValveCommand(0.98, 0.0, 0.0, Gear.BACKWARD)
INTO_F = ValveCommand(0.0, 0.0, 0.98, Gear.FORWARD)
INTO_N = ValveCommand(0.0, 0.98, 0.0, Gear.NEUTRAL)
NO_BLOW = SafetyBlow(Chamber.NONE, False, 0.0)

BusFrame = tuple[int, Frame]
Commands = list[tuple[int, ValveCommand]]
SHIFT_TO_B: Commands = [(0, OFF), (40, INTO_B), (240, OFF)]


class Rows:
    """A trace sink in memory."""

    def __init__(self) -> None:
        self.blocks: list[np.ndarray] = []

    def write(self, rows: np.ndarray) -> None:
        self.blocks.append(rows.copy())

    def __getitem__(self, column: str) -> np.ndarray:
        return np.concatenate(self.blocks)[:, TRACE_COLUMNS.index(column)]


class Run:
    """A plant and a sender of commands every 10 ms, whose frames arrive 0.4 and 0.7 ms later."""

    def __init__(
        self,
        config: PlantConfig,
        commands: Commands,
        end_ms: float,
        blow: SafetyBlow = NO_BLOW,
        last_tick_ms: float = 1e9,
        extra_grants_ns: tuple[int, ...] = (),
        rows_at_once: int = 1,
    ) -> None:
        self.rows = Rows()
        self.events: list[tuple[float, str, Mapping[str, float]]] = []
        self.node = PlantNode(
            config,
            NOMINAL,
            self.rows,
            lambda *e: self.events.append(e),
            trace_rows_at_once=rows_at_once,
        )
        self.released: list[BusFrame] = []
        end_ns = round(end_ms * MS)
        inbox = self._frames(commands, min(end_ns, round(last_tick_ms * MS)), blow)
        next_ns = self.node.start()
        extra = sorted(extra_grants_ns)
        while True:
            grant_ns = min([next_ns, end_ns, *extra])
            extra = [t for t in extra if t > grant_ns]
            due = [frame for frame in inbox if frame[0] <= grant_ns]
            inbox = inbox[len(due) :]
            frames, next_ns = self.node.advance(grant_ns, due)
            self.released += frames
            if grant_ns == end_ns:
                break
        self.node.close()

    @staticmethod
    def _frames(commands: Commands, end_ns: int, blow: SafetyBlow) -> list[BusFrame]:
        valves, blows = Protector(ValveCommand), Protector(SafetyBlow)
        frames = []
        for tick_ns in range(0, end_ns + 1, 10 * MS):
            command = [c for t_ms, c in commands if t_ms * MS <= tick_ns][-1]
            frames.append((tick_ns + 400_000, valves.protect(command)))
            frames.append((tick_ns + 700_000, blows.protect(blow)))
        return frames

    def of(self, message_type: type) -> list[tuple[int, object]]:
        decoded = [(t, decode(frame)) for t, frame in self.released]
        return [(t, message) for t, message in decoded if isinstance(message, message_type)]

    def named(self, name: str) -> list[tuple[float, Mapping[str, float]]]:
        return [(t, values) for t, event, values in self.events if event == name]

    def instants(self, *names: str) -> list[tuple[str, float]]:
        return [(name, t) for t, name, _ in self.events if name in names]


@pytest.fixture(scope="module")
def lab() -> Run:
    return Run(PlantConfig(), SHIFT_TO_B, 400)


def test_shift_by_frames_is_the_reference_stroke(lab: Run) -> None:
    """Arrival and impact speed of an independent solver, counted from the command's arrival."""
    (arrived, values), *_ = lab.named("stay_stop")
    assert arrived - 0.0404 == pytest.approx(0.050750315 - 0.01, abs=1e-6)
    assert values["speed_m_s"] == pytest.approx(0.9412373, rel=1e-5)
    assert values["position_m"] == pytest.approx(0.01285, abs=1e-12)
    assert lab.instants("coil_B_on", "valve_B_open", "coil_B_off", "valve_B_close") == [
        ("coil_B_on", pytest.approx(0.0404, abs=1e-12)),
        ("valve_B_open", pytest.approx(0.0484, abs=1e-12)),
        ("coil_B_off", pytest.approx(0.2404, abs=1e-12)),
        ("valve_B_close", pytest.approx(0.2754, abs=1e-12)),
    ]


def test_pieces_give_the_motion_of_one_call(lab: Run) -> None:
    whole = LengthStroke(NOMINAL)
    instants = np.arange(0, 400 * MS + 1, MS)
    states = whole.advance(400 * MS, [(48_400_000, 0, 1.0), (275_400_000, 0, 0.0)], instants)
    columns = [whole.columns.index(c) for c in ("position_m", "pressure_B_pa", "pressure_N_pa")]
    np.testing.assert_allclose(lab.rows["position_m"], states[:, columns[0]], atol=1e-9)
    np.testing.assert_allclose(lab.rows["pressure_B_pa"], states[:, columns[1]], atol=0.5)
    np.testing.assert_allclose(lab.rows["pressure_N_pa"], states[:, columns[2]], atol=0.5)


@pytest.mark.parametrize(
    ("initial", "command", "end_m"),
    [("N", INTO_F, -0.01285), ("B", INTO_N, 0.0), ("F", INTO_N, 0.0), ("N", INTO_B, 0.01285)],
)
def test_all_four_shifts(initial: str, command: ValveCommand, end_m: float) -> None:
    config = msgspec.structs.replace(PlantConfig(), initial=initial)
    run = Run(config, [(0, OFF), (40, command)], 200)
    assert run.node.stroke.position_m == pytest.approx(end_m, abs=1e-9)
    assert run.named("balance")[0][1]["closed"] == 1.0


def test_frames_leave_on_a_static_schedule(lab: Run) -> None:
    for message_type in (PositionPulse, DrivelineSpeeds, PlantMotion, PlantPressures):
        assert [t for t, _ in lab.of(message_type)] == list(range(6_500_000, 400 * MS, 10 * MS))
    config = PlantConfig(
        sensor=SensorConfig(period_s=0.0025, phase_s=0.001),
        speeds_period_s=0.005,
        truth_period_s=0.02,
    )
    run = Run(config, [(0, OFF)], 60)
    assert [t for t, _ in run.of(PositionPulse)] == list(range(2_500_000, 60 * MS + 1, 2_500_000))
    assert [t for t, _ in run.of(DrivelineSpeeds)] == list(range(2_500_000, 60 * MS + 1, 5 * MS))
    assert [t for t, _ in run.of(PlantMotion)] == list(range(2_500_000, 60 * MS + 1, 20 * MS))


def test_an_interval_that_skips_an_event_is_refused() -> None:
    node = PlantNode(PlantConfig(), NOMINAL)
    assert node.start() == 6_500_000
    with pytest.raises(ValueError, match="skips the event at 6500000"):
        node.advance(7 * MS, [])


def test_protected_frames_pass_their_receivers(lab: Run) -> None:
    for message_type in (PositionPulse, DrivelineSpeeds):
        receiver: Receiver[object] = Receiver(message_type)
        statuses = [
            receiver.receive(t, frame)
            for t, frame in lab.released
            if type(decode(frame)) is message_type
        ]
        assert statuses[0] is E2eStatus.INITIAL
        assert set(statuses[1:]) == {E2eStatus.OK}


def test_pulse_tells_the_position_at_the_middle_of_the_pulse() -> None:
    config = PlantConfig(trace_period_s=0.00005, sensor=SensorConfig(coil_temperature_k=313.15))
    run = Run(config, SHIFT_TO_B, 150)
    sensor = InductiveSensor.from_parameters(NOMINAL)
    position = run.rows["position_m"]
    moving = 0
    for t_ns, message in run.of(PositionPulse):
        assert isinstance(message, PositionPulse)
        at_ns = t_ns - 1_500_000 + 450_000
        x = float(position[at_ns // 50_000])
        moving += 0.0 < x < 0.0128
        assert message.pulse_s == pytest.approx(sensor.pulse_s(x, 313.15), abs=1e-12)
        assert message.coil_temperature_k == pytest.approx(313.15, abs=0.02)
        assert message.sample_index == t_ns // (10 * MS)
    assert moving >= 2


def test_sensor_delay_moves_the_frames_and_not_the_measurement() -> None:
    plain = Run(PlantConfig(), SHIFT_TO_B, 200)
    late = Run(PlantConfig(sensor=SensorConfig(delay_s=0.023)), SHIFT_TO_B, 200)
    pulses = [(t + 23 * MS, m) for t, m in plain.of(PositionPulse) if t + 23 * MS <= 200 * MS]
    assert late.of(PositionPulse) == pulses
    assert len(pulses) == 18


def test_truth_frames_tell_the_state_at_their_release(lab: Run) -> None:
    stroke = LengthStroke(NOMINAL)
    times = np.array([t for t, _ in lab.of(PlantMotion)])
    states = stroke.advance(400 * MS, [(48_400_000, 0, 1.0), (275_400_000, 0, 0.0)], times)
    for row, (_, motion), (_, pressures) in zip(
        states, lab.of(PlantMotion), lab.of(PlantPressures), strict=True
    ):
        assert isinstance(motion, PlantMotion) and isinstance(pressures, PlantPressures)
        assert motion.position_m == pytest.approx(row[0], abs=0.6e-6)
        assert motion.velocity_m_s == pytest.approx(row[1], abs=0.3e-3)
        assert motion.piston_1_m == pytest.approx(row[2], abs=0.6e-6)
        assert pressures.pressure_b_pa == pytest.approx(row[6], abs=26.0)
        assert pressures.supply_pa == 900_000.0


def test_a_sensor_fault_reaches_the_bus() -> None:
    fault = SensorFault(kind="slow", start_s=0.05)
    plain = Run(PlantConfig(), SHIFT_TO_B, 300).of(PositionPulse)
    faulty = Run(PlantConfig(sensor_faults=(fault,)), SHIFT_TO_B, 300).of(PositionPulse)
    assert faulty == plain[:5] + plain[5::4]


def test_still_charged_chamber_vents_after_its_valve_has_closed() -> None:
    run = Run(PlantConfig(charged=("N",)), [(0, OFF)], 300)
    assert run.instants("valve_N_close") == [("valve_N_close", pytest.approx(0.035, abs=1e-12))]
    pressure = run.rows["pressure_N_pa"]
    assert np.all(pressure[:36] == pytest.approx(900_000.0, rel=1e-9))
    assert pressure[40] < 880_000.0 and pressure[300] < 110_000.0
    assert run.rows["valve_N"][[0, 34, 35]].tolist() == [1.0, 1.0, 0.0]


def test_smaller_duty_closes_sooner_when_asked_for() -> None:
    push = ValveCommand(0.5, 0.0, 0.0, Gear.BACKWARD)
    run = Run(PlantConfig(closing_follows_duty=True), [(0, OFF), (40, push), (60, OFF)], 120)
    (_, off), (_, closed) = run.instants("coil_B_off", "valve_B_close")
    current = 0.5 * (1.0 - np.exp(-0.02 / 0.0293))
    assert current < 0.34
    assert closed - off == pytest.approx(0.004, abs=1e-5)


def test_blow_fills_its_chamber_without_a_command() -> None:
    run = Run(PlantConfig(), [(0, OFF)], 100, blow=SafetyBlow(Chamber.N, True, 0.15))
    assert run.instants("coil_N_on", "valve_N_open") == [
        ("coil_N_on", pytest.approx(0.0107, abs=1e-12)),
        ("valve_N_open", pytest.approx(0.0187, abs=1e-12)),
    ]
    assert run.rows["pressure_N_pa"][-1] > 450_000.0


def test_synchronizer_blocks_until_the_shafts_agree() -> None:
    config = PlantConfig(mounted=True, driveline=DrivelineConfig(residual_rad_s=6.0))
    run = Run(config, [(0, OFF), (40, INTO_B), (340, INTO_N)], 600)
    ((blocked, values),) = run.named("sync_block")
    assert values["position_m"] == pytest.approx(0.006, abs=1e-12)
    spent = run.rows["spent_impulse_n_s"]
    released = int(np.argmax(run.rows["position_m"] > 0.006))
    assert released - blocked * 1000 > 10
    assert spent[released] == pytest.approx(6.0 * 0.25 / 0.09, rel=1e-9)
    difference = {
        t // MS: m.input_rad_s - m.output_rad_s
        for t, m in run.of(DrivelineSpeeds)
        if isinstance(m, DrivelineSpeeds)
    }
    before = [d for t, d in difference.items() if t < blocked * 1000]
    during = [d for t, d in difference.items() if blocked * 1000 < t < released]
    assert before == pytest.approx([6.0] * len(before), abs=1e-3)
    assert during == sorted(during, reverse=True)
    assert 0.0 < during[-1] < during[0] < 6.0
    assert difference[released // 10 * 10 + 6] == 0.0
    assert max(d for t, d in difference.items() if t > 340) == pytest.approx(30.0, abs=0.01)
    assert run.node.stroke.position_m == pytest.approx(0.0, abs=1e-9)


def test_stated_impulse_of_the_gear_that_is_asked_for() -> None:
    line = DrivelineConfig(impulse_backward_n_s=14.0, impulse_forward_n_s=50.0)
    times = {}
    for command, impulse in ((INTO_B, 14.0), (INTO_F, 50.0)):
        config = PlantConfig(mounted=True, mesh_force_n=800.0, driveline=line)
        run = Run(config, [(0, OFF), (40, command)], 400)
        assert run.node.stroke.spent_impulse_n_s == pytest.approx(impulse)
        assert abs(run.node.stroke.position_m) == pytest.approx(0.01285)
        times[impulse] = run.named("stay_stop")[0][0]
    assert times[50.0] - times[14.0] > 0.01


def test_lab_rig_has_no_synchronizer() -> None:
    run = Run(PlantConfig(driveline=DrivelineConfig(residual_rad_s=6.0)), SHIFT_TO_B, 120)
    assert run.named("sync_block") == []
    assert run.node.stroke.position_m == pytest.approx(0.01285)


@pytest.mark.parametrize("damper", ["incompressible", "compressible"])
def test_oil_pressure_is_recorded(damper: str) -> None:
    run = Run(msgspec.structs.replace(PlantConfig(), damper=damper), SHIFT_TO_B, 160)
    oil = run.rows["pressure_oil2_pa"]
    assert oil[0] == pytest.approx(101_325.0)
    assert 1e6 < oil.max() < 5e6
    assert run.named("stay_stop")[0][1]["speed_m_s"] < 0.4
    assert np.all(Run(PlantConfig(), SHIFT_TO_B, 20).rows["pressure_oil2_pa"] == 101_325.0)


def test_trace_rows_are_regular_and_show_what_changed_at_their_instant(lab: Run) -> None:
    np.testing.assert_array_equal(lab.rows["time_s"], np.arange(401) / 1000)
    rows = Run(PlantConfig(trace_period_s=0.0001), SHIFT_TO_B, 300).rows
    assert rows["cmd_B"][[403, 404, 2403, 2404]].tolist() == [
        0.0, pytest.approx(0.98, abs=1e-4), pytest.approx(0.98, abs=1e-4), 0.0,
    ]  # fmt: skip
    assert rows["valve_B"][[483, 484, 2753, 2754]].tolist() == [0.0, 1.0, 1.0, 0.0]
    assert rows["pulse_s"][[64, 65]].tolist() == [0.0, pytest.approx(0.0009)]
    assert rows["pressure_B_pa"][484] == pytest.approx(101_325.0, abs=0.01)
    assert rows["pressure_B_pa"][485] > 101_400.0
    for column in ("cmd_N", "cmd_F", "valve_N", "valve_F"):
        assert not rows[column].any()


def test_events_are_reported_in_order_and_the_balance_once(lab: Run) -> None:
    times = [t for t, _, _ in lab.events]
    assert times == sorted(times)
    lab.node.close()
    ((at, balance),) = lab.named("balance")
    assert at == 0.4
    assert balance["closed"] == 1.0 and balance["air_in_kg"] == pytest.approx(9.8e-4, rel=0.02)


def test_without_sinks_nothing_else_changes(lab: Run) -> None:
    node = PlantNode(PlantConfig(trace_period_s=None), NOMINAL)
    next_ns, released = node.start(), []
    inbox = Run._frames(SHIFT_TO_B, 400 * MS, NO_BLOW)
    while next_ns <= 400 * MS:
        due = [frame for frame in inbox if frame[0] <= next_ns]
        inbox = inbox[len(due) :]
        frames, next_ns = node.advance(next_ns, due)
        released += frames
    assert released == lab.released


@pytest.mark.parametrize("period_s", [0.0001, 0.00045, 0.003])
def test_trace_rows_made_together_have_the_bits_of_those_made_one_by_one(period_s: float) -> None:
    config = PlantConfig(trace_period_s=period_s, mounted=True, damper="incompressible")
    one, many = (Run(config, SHIFT_TO_B, 300, rows_at_once=n) for n in (1, 2000))
    assert len(many.rows.blocks) < 0.1 * len(one.rows.blocks)
    assert b"".join(b.tobytes() for b in many.rows.blocks) == b"".join(
        b.tobytes() for b in one.rows.blocks
    )


def test_same_inputs_same_bits() -> None:
    fault = SensorFault(kind="garbage", start_s=0.1)
    config = PlantConfig(
        mounted=True,
        seed=5,
        sensor=SensorConfig(noise_sd_s=2e-6),
        sensor_faults=(fault,),
        driveline=DrivelineConfig(residual_rad_s=6.0),
    )
    first, again = Run(config, SHIFT_TO_B, 300), Run(config, SHIFT_TO_B, 300)
    assert first.released == again.released and first.events == again.events
    for one, other in zip(first.rows.blocks, again.rows.blocks, strict=True):
        assert one.tobytes() == other.tobytes()
    other_seed = Run(msgspec.structs.replace(config, seed=6), SHIFT_TO_B, 300)
    assert other_seed.of(PositionPulse) != first.of(PositionPulse)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 299 * MS), max_size=10))
def test_valves_move_at_the_same_instants_however_often_time_is_granted(grants: list[int]) -> None:
    names = ("coil_B_on", "coil_B_off", "valve_B_open", "valve_B_close")
    plain = Run(PlantConfig(), [(0, OFF), (40, INTO_B)], 300, last_tick_ms=150)
    more = Run(
        PlantConfig(),
        [(0, OFF), (40, INTO_B)],
        300,
        last_tick_ms=150,
        extra_grants_ns=tuple(set(grants)),
    )
    assert more.instants(*names) == plain.instants(*names)
    assert len(plain.instants(*names)) == 4
    np.testing.assert_allclose(more.rows["position_m"], plain.rows["position_m"], atol=1e-8)


def test_impossible_parameters_are_named() -> None:
    for changes, charged, text in (
        ({"valve.duty_nominal": 1.2}, (), "valve.duty_nominal"),
        ({"valve.duty_nominal": 0.3}, ("B",), "valve.duty_nominal"),
        ({"valve.D_rise": -0.001}, (), "valve.D_rise"),
        ({"valve.duty_open": 0.2}, (), "valve.duty_open"),
        ({"position_sensor.t_mid": 0.002}, (), "sensor.capture_s"),
        ({"synchronizer.x_block": 0.0}, (), "synchronizer.x_block"),
    ):
        config = msgspec.structs.replace(PlantConfig(), charged=charged)
        with pytest.raises(InputError, match=text):
            PlantNode(config, NOMINAL.override(changes))


def test_events_that_were_told_are_not_kept(lab: Run) -> None:
    assert lab.events and lab.node.stroke.events == []
