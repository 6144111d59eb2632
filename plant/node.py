"""The plant as a participant on the bus: valve commands in, sensor frames and truth out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from can_dbc.codec import can_id_of, decode, encode
from can_dbc.e2e import Protector
from can_dbc.errors import CodecError
from can_dbc.frame import Frame
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    DrivelineSpeeds,
    Gear,
    OverrideMode,
    PlantMotion,
    PlantPressures,
    PositionPulse,
    Tsc1,
)
from plant.devices.coil import make_valve
from plant.devices.conditions import ChamberName, Conditions
from plant.devices.driveline import (
    BACKWARD,
    FORWARD,
    NO_GEAR,
    Driveline,
    DrivelineConfig,
    toothed_wheels,
)
from plant.devices.position_circuit import PositionCircuit, SensorConfig, SensorFault
from plant.devices.sensors import InductiveSensor
from plant.devices.signal_faults import SpeedFault, SpeedSensors, TemperatureFault, Thermometer
from plant.devices.valve import CoilConfig, ValveTiming, seconds_to_ns
from plant.devices.valve_driver import Duties, ValveDriver, ValveDriverConfig
from plant.devices.valve_faults import Switch, ValveFault, ValveGroup
from plant.errors import InputError
from plant.integrator.hybrid import Balance
from plant.kernel.packing import Load
from plant.parameters import ParameterSet
from plant.systems.length_stroke import LengthStroke
from plant.trace import CMD, CURRENT, PULSE, SPEEDS, VALVE, TraceRows, TraceSink, Update

Released = list[tuple[int, Frame]]

CHAMBERS: tuple[ChamberName, ...] = ("B", "N", "F")
DIRECTIONS = {Gear.BACKWARD: BACKWARD, Gear.FORWARD: FORWARD}
REFERRED = {BACKWARD: Gear.BACKWARD, FORWARD: Gear.FORWARD, NO_GEAR: Gear.UNKNOWN}


EventSink = Callable[[float, str, Mapping[str, float]], None]
"""Takes (time in s, name, values) of an event located inside the run; see `PlantNode`."""


class PlantConfig(Conditions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The actuator's conditions and the schedule of its frames; the numbers are in the model set.

    initial: gear at time 0; the valves of chambers charged then are open but no longer energised.
    trace_period_s: of the trace rows, None for none. seed: of the sensor's noise and of the faults.
    """

    initial: ChamberName = "N"
    coil: CoilConfig = CoilConfig()
    driveline: DrivelineConfig = DrivelineConfig()
    valve_driver: ValveDriverConfig = ValveDriverConfig()
    sensor: SensorConfig = SensorConfig()
    sensor_faults: tuple[SensorFault, ...] = ()
    temperature_faults: tuple[TemperatureFault, ...] = ()
    speed_faults: tuple[SpeedFault, ...] = ()
    valve_faults: tuple[ValveFault, ...] = ()
    trace_period_s: Annotated[float, Meta(ge=1e-5, le=1.0)] | None = 0.001
    seed: Annotated[int, Meta(ge=0)] = 0


class _Cycle:
    """Instants first_ns + k period_ns; `next_ns` is the one to come."""

    def __init__(self, period_ns: int, phase_ns: int) -> None:
        self.period_ns = period_ns
        self.next_ns = phase_ns % period_ns

    def take(self, now_ns: int) -> bool:
        """Whether `now_ns` is the next instant; if so, move on."""
        if now_ns != self.next_ns:
            return False
        self.next_ns += self.period_ns
        return True


class PlantNode:
    """Length stroke, valves with their driver, position sensor and driveline: one participant.

    Its events are the instants at which it publishes, all of them a static schedule. Everything
    inside an interval acts at its own instant: arrival of a command, timeout, end of a blow, move
    of a valve, measurement; at one instant frames come before timers, timers before valve moves
    (one that is due is not cancelled by a command of that instant), these in the order B, N, F,
    and a measurement or trace row sees them all.

    Events handed to `on_event`: "stay_stop" and the other resets of the motion (position_m,
    speed_m_s, energy_j, and peak_force_n of a contact of stiffness stops.soft_k that takes that
    energy, sqrt(2 k E)), "sync_block" and "sync_unblock", "valve_B_open" and "valve_B_close" (the
    plunger), "coil_B_on" and "coil_B_off" (energised or not), N and F alike, and on closing
    "balance".
    Raises InputError for conditions outside their range.
    """

    name = "plant"

    def __init__(
        self,
        config: PlantConfig,
        parameters: ParameterSet,
        trace: TraceSink | None = None,
        on_event: EventSink | None = None,
        trace_rows_at_once: int = 1,
    ) -> None:
        """`trace_rows_at_once`: how many rows the trace waits for, the last ones until `close`."""
        self.config = config
        self._on_event = on_event
        self._contact_n_m = parameters.value("stops.soft_k")
        duty = parameters.value("valve.duty_nominal")
        timing = _timing(config, parameters, duty)
        self.stroke = LengthStroke(
            parameters,
            initial=config.initial,
            supply_pressure_pa=config.supply_pressure_pa,
            charged=config.charged,
            load=Load(
                damper=config.damper,
                mounted=config.mounted,
                mesh_force_n=config.mesh_force_n,
                pull_force_n=config.pull_force_n,
            ),
        )
        if self.stroke.valve_delays_ns is not None:
            rise_ns, fall_ns = self.stroke.valve_delays_ns
            timing = replace(timing, rise_ns=rise_ns, fall_ns=fall_ns)
        if config.drive == "coil":
            _refuse_delays(config, timing, ValveTiming.from_parameters(parameters))
        trace_ns = 0 if trace is None else seconds_to_ns(config.trace_period_s or 0.0)
        valves = [
            make_valve(config.drive, timing, config.coil, is_open, duty * is_open, trace_ns)
            for is_open in (c in config.charged for c in CHAMBERS)
        ]
        self.valve_group = ValveGroup(valves, CHAMBERS, config.valve_faults, config.seed)
        self.driver = ValveDriver(config.valve_driver, duty, timing.duty_open)
        self.supply_pressure_pa = float(self.stroke.packed.p_supply)
        self.circuit = PositionCircuit(
            config.sensor,
            InductiveSensor.from_parameters(parameters),
            parameters.value("length.stroke") + 0.001,  # worn stops and bounce are measured too
            config.sensor_faults,
            config.seed,
            Thermometer(config.temperature_faults, config.seed),
        )
        self._speed_sensors = SpeedSensors(
            config.speed_faults, config.seed, toothed_wheels(config.driveline, config.seed)
        )
        self.driveline = Driveline(
            config.driveline,
            parameters.value("synchronizer.x_block"),
            self.stroke.position_m,
            has_synchronizer=config.mounted,
        )
        phase_ns = self.circuit.next_report_ns
        self._speeds = _Cycle(seconds_to_ns(config.speeds_period_s), phase_ns)
        self._truth = _Cycle(seconds_to_ns(config.truth_period_s), phase_ns)
        self._rows = TraceRows(
            self.stroke, config.damper, trace, trace_ns, trace_rows_at_once, config.drive
        )
        self._protect_pulse: Protector[PositionPulse] = Protector(PositionPulse)
        self._protect_speeds: Protector[DrivelineSpeeds] = Protector(DrivelineSpeeds)
        self._closed = False

    # --- participant ------------------------------------------------------------------------
    def start(self) -> int:
        """Settle time 0 and return the simulated instant [ns] of the first event."""
        self.stroke.advance(0)  # loads the compiled kernel before anybody waits for a grant
        updates: list[Update] = []
        for chamber, valve in enumerate(self.valve_group.valves):
            updates.append((0, VALVE + chamber, float(valve.is_open)))
            valve.command(0, 0.0)
        updates += self._currents()
        self._arm_synchronizer(0)
        updates.append((0, SPEEDS, self.driveline.input_rad_s))
        updates.append((0, SPEEDS + 1, self.driveline.output_rad_s))
        self._rows.write(self._rows.instants_ns(0), [self.stroke.row()[np.newaxis]], updates)
        return self._next_event_ns()

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[Released, int]:
        """Advance to `until_ns` with the frames that arrived. Raises ValueError if that skips an event of this node."""
        if until_ns > self._next_event_ns():
            raise ValueError(f"advance to {until_ns} ns skips the event at {self._next_event_ns()}")
        if self.config.driveline.follows_requests:
            self._take_engine_requests(deliveries)
        commands = self.driver.advance(until_ns, deliveries)
        coils, switches = self.valve_group.drive(until_ns, commands)
        updates = self._valve_updates(commands, switches)
        measured = self.circuit.measurement_instants_ns(until_ns)
        rows = self._rows.instants_ns(until_ns)
        samples = np.array(sorted((*rows, *measured)) if measured else rows, dtype=np.int64)
        states = self.stroke.advance(until_ns, switches, samples)
        row_states, at = [], 0
        for number, instant in enumerate(measured):
            before = max(0, -((rows.start - instant) // rows.step)) if rows else 0
            here = number + min(before, len(rows))  # a row of the same instant comes after
            self.circuit.measure(float(states[here, 0]))
            row_states.append(states[at:here])
            at = here + 1
        row_states.append(states[at:] if measured else states)
        frames = self._publish(until_ns, updates)
        self._report_events(coils, switches)
        self._rows.write(rows, row_states, updates)
        return [(until_ns, frame) for frame in frames], self._next_event_ns()

    def close(self) -> None:
        """Hand the balances to `on_event`; the sinks stay open."""
        if self._closed:
            return
        self._closed = True
        self._rows.flush()
        if self._on_event is not None:
            self._on_event(self.stroke.now_ns / NS_PER_S, "balance", _flat(self.balance()))

    def balance(self) -> Balance:
        """Energy and gas balances since the start; air_in_kg is the air used."""
        return self.stroke.balance()

    # --- one interval -----------------------------------------------------------------------
    def _next_event_ns(self) -> int:
        return min(self.circuit.next_report_ns, self._speeds.next_ns, self._truth.next_ns)

    def _valve_updates(
        self, commands: Sequence[tuple[int, Duties]], switches: Sequence[Switch]
    ) -> list[Update]:
        updates = [
            (at, CMD + chamber, duty)
            for at, duties in commands
            for chamber, duty in enumerate(duties)
        ]
        updates += ((at, VALVE + chamber, u) for at, chamber, u in switches)
        updates += self._currents()
        return updates

    def _currents(self) -> list[Update]:
        return [(at, CURRENT + chamber, amps) for at, chamber, amps in self.valve_group.currents()]

    def _publish(self, now_ns: int, updates: list[Update]) -> list[Frame]:
        """Frames of the events due at `now_ns`."""
        frames = []
        if now_ns == self.circuit.next_report_ns:
            reading = self.circuit.report()
            if reading is not None:
                frames.append(self._protect_pulse.protect(PositionPulse(*reading)))
                updates.append((now_ns, PULSE, reading.pulse_s))
        if self._speeds.take(now_ns):
            self._arm_synchronizer(now_ns)
            line = self.driveline
            speeds = self._speed_sensors.report(
                now_ns, line.input_rad_s, line.output_rad_s, line.ratio
            )
            if speeds is not None:
                message = DrivelineSpeeds(*speeds, REFERRED[line.referred])
                frames.append(self._protect_speeds.protect(message))
            updates.append((now_ns, SPEEDS, line.input_rad_s))
            updates.append((now_ns, SPEEDS + 1, line.output_rad_s))
        if self._truth.take(now_ns):
            stroke = self.stroke
            # the frames saturate at the ends of their ranges
            motion = (stroke.position_m, stroke.velocity_m_s, *stroke.pistons_m)
            limits = (0.032767, 16.0, 0.032767, 0.032767)
            limited = [max(-lim, min(lim, v)) for v, lim in zip(motion, limits, strict=True)]
            frames.append(encode(PlantMotion(*limited)))
            pressures = (*stroke.pressures_pa, self.supply_pressure_pa)
            frames.append(encode(PlantPressures(*(min(p, 3_276_750.0) for p in pressures))))
        return frames

    def _take_engine_requests(self, deliveries: Sequence[tuple[int, Frame]]) -> None:
        for arrival_ns, frame in deliveries:
            if frame.can_id == can_id_of(Tsc1):
                with suppress(CodecError):
                    request = decode(frame)
                    assert isinstance(request, Tsc1)
                    asked = request.mode is OverrideMode.SPEED
                    self.driveline.request(arrival_ns, request.speed_rad_s if asked else None)

    def _arm_synchronizer(self, now_ns: int) -> None:
        stroke = self.stroke
        direction = DIRECTIONS.get(self.driver.target, NO_GEAR)
        impulse = self.driveline.advance(
            now_ns, stroke.position_m, stroke.spent_impulse_n_s, direction
        )
        if impulse is not None:
            stroke.set_sync_impulse(impulse)

    def _report_events(self, coils: Sequence[Switch], switches: Sequence[Switch]) -> None:
        if not (coils or switches or self.stroke.events):
            return
        events = self.stroke.events.copy()
        self.stroke.events.clear()  # a long run must not collect them
        if self._on_event is None:
            return
        reports: list[tuple[float, str, dict[str, float]]] = [
            (instant / NS_PER_S, f"coil_{CHAMBERS[chamber]}_{'on' if on else 'off'}", {})
            for instant, chamber, on in coils
        ]
        for event in events:
            values = asdict(event)
            time_s, name = values.pop("time_s"), values.pop("name")
            values["peak_force_n"] = math.sqrt(2.0 * self._contact_n_m * event.energy_j)
            of = {"stop": "stay_", "block": "sync_", "unblock": "sync_"}.get(name, "")
            reports.append((time_s, of + name.replace(" ", "_"), values))
        for instant, chamber, u in switches:
            name = f"valve_{CHAMBERS[chamber]}_{'open' if u else 'close'}"
            reports.append((instant / NS_PER_S, name, {}))
        reports.sort(key=lambda event: event[0])
        for time_s, name, values in reports:
            self._on_event(time_s, name, values)


def _timing(config: PlantConfig, parameters: ParameterSet, duty: float) -> ValveTiming:
    """Return the timing of the valves. Raises InputError for a duty that contradicts the conditions."""
    if not 0.0 <= duty <= 1.0:
        raise InputError(f"valve.duty_nominal: {duty:g}; expected 0 to 1")
    timing = ValveTiming.from_parameters(parameters, config.closing_follows_duty)
    if config.charged and duty < timing.duty_open:
        raise InputError(
            f"valve.duty_nominal: {duty:g}; expected at least valve.duty_open, "
            f"{timing.duty_open:g}, where a chamber is charged"
        )
    return timing


def _refuse_delays(config: PlantConfig, timing: ValveTiming, nominal: ValveTiming) -> None:
    """Raise InputError for settings of the delays that a valve with its coil would not follow."""
    if config.closing_follows_duty:
        raise InputError(
            'plant.closing_follows_duty: true; expected false with plant.drive = "coil"'
        )
    if (timing.rise_ns, timing.fall_ns) != (nominal.rise_ns, nominal.fall_ns):
        raise InputError(
            'plant.drive: "coil"; expected "delays" with an effect on the valve delays'
        )
    for fault in config.valve_faults:
        if fault.kind == "slow":
            raise InputError('valve_fault: slow; expected another kind with plant.drive = "coil"')


def _flat(balance: Balance) -> dict[str, float]:
    """Numbers of the balances, those of the chambers under their names."""
    numbers: dict[str, float] = {"closed": float(balance.closed), **asdict(balance)}
    del numbers["gas_residual_j"]
    for chamber, residual in zip(CHAMBERS, balance.gas_residual_j, strict=True):
        numbers[f"gas_residual_{chamber}_j"] = residual
    return numbers
