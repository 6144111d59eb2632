"""The keys of a scenario, each with its type, bounds and default, and what contradicts what."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from can_dbc.errors import InputError
from can_dbc.typed_toml import one_line
from controller.config import FirmwareConfig
from plant.devices.conditions import Conditions
from plant.devices.driveline import DrivelineConfig
from plant.devices.position_circuit import SensorConfig, SensorFault
from plant.devices.signal_faults import SpeedFault, TemperatureFault
from plant.devices.valve import CoilConfig
from plant.devices.valve_driver import ValveDriverConfig
from plant.devices.valve_faults import ValveFault
from sil.coupling.faults import BusFault, FaultPlan
from sil.files.overrides import toml_value
from sil.files.quantity import quantity
from sil.firmware.load import in_module
from sil.nodes.vehicle import VehicleConfig
from sil.simulation.expectations import Expectations, GearName

FAULT_TABLES = ("fault", "sensor_fault", "temperature_fault", "speed_fault", "valve_fault")
"""Lists of faults: of the bus, and of the plant's devices, which are fields of `PlantConfig` with an s."""

Seconds = Annotated[float, Meta(ge=0.0, le=86400.0)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a scenario file; unknown names are refused."""


class Request(_Table, frozen=True, kw_only=True):
    """A gear that the driver requests."""

    at_s: Seconds
    """Time from which the driver requests the gear, until the next request."""
    gear: GearName
    """The gear requested."""


class DriverTable(_Table, frozen=True, kw_only=True):
    """When the driver's frames are sent: at phase_s + k period_s."""

    period_s: Annotated[float, Meta(ge=0.001, le=1.0)] = 0.02
    """Period of the ShiftRequest frames."""
    phase_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Time of the first ShiftRequest frame."""


class BusTable(_Table, frozen=True, kw_only=True):
    """The CAN bus and the load that other nodes put on it."""

    bitrate: Literal[125_000, 250_000, 500_000, 1_000_000] = 500_000
    """Bit rate in bit/s."""
    extra_load: Annotated[float, Meta(ge=0.0, le=3.0)] = 0.0
    """Share of the bus that the frames of other nodes take; above 1 it is overloaded."""
    extra_priority: Annotated[int, Meta(ge=0, le=7)] = 3
    """Priority of the frames of other nodes; 0 is the highest."""
    send_buffer: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """Frames that a node can have waiting; further ones are lost. If left out, any number."""
    mailboxes: bool = True
    """Newer content of a message overwrites what its node has not sent yet, as in a CAN
    controller with one transmit object for each message; otherwise a node sends all, in the
    order of release."""
    guest: bool = False
    """A program of the user takes part as the node "guest"; the run waits for it to join."""


class FirmwareTable(_Table, frozen=True, kw_only=True):
    """A firmware of the user with limits of what it costs, see `Scenario.firmware`."""

    file: str
    max_instructions: Annotated[int, Meta(ge=1)] | None = None
    max_stack_bytes: Annotated[int, Meta(ge=1)] | None = None


class ClockTable(_Table, frozen=True, kw_only=True):
    """Clocks that run faster or slower than simulated time, or that have run before."""

    controller_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """How much faster than simulated time the controller's clock runs, in millionths."""
    driver_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """The same for the driver's clock."""
    controller_start_s: Annotated[float, Meta(ge=0.0, le=1e7)] = 0.0
    """What the controller's clock shows at the start of the run, as counters of milliseconds or
    microseconds may overflow."""


class Scenario(_Table, frozen=True, kw_only=True):
    """One run, complete."""

    name: Annotated[str, Meta(min_length=1, max_length=80)]
    """Name of the run, in pictures, pages and folders."""
    description: str = ""
    """What the scenario shows; its first line is printed by opc4 run --list."""
    duration_s: Annotated[float, Meta(gt=0.0, le=86400.0)]
    """Simulated time of the run."""
    seed: Annotated[int, Meta(ge=0, le=(1 << 53) - 1)] = 1
    """Seed of all random numbers."""
    initial_gear: GearName = "neutral"
    """Gear at the start."""
    request: list[Request]
    """Requests of the driver, in order of time."""
    driver: DriverTable = DriverTable()
    vehicle: VehicleConfig | None = None
    """A truck around the actuator; without it the driver asks the controller for gears directly."""
    plant: Conditions = Conditions()
    driveline: DrivelineConfig = DrivelineConfig()
    valve_driver: ValveDriverConfig = ValveDriverConfig()
    coil: CoilConfig = CoilConfig()
    sensor: SensorConfig = SensorConfig()
    controller: FirmwareConfig = FirmwareConfig()
    firmware: str = ""
    """FILE.py, FILE.py:CLASS, FILE.c or FILE.wasm of a user's own firmware in place of ours, or the
    folder of another checkout of this project with its firmware, relative to the scenario; c for ours
    in C, empty for ours in Python. Or a table: file, and max_instructions and max_stack_bytes, short for
    limits in [expect.metrics]."""
    bus: BusTable = BusTable()
    clock: ClockTable = ClockTable()
    fault: list[BusFault] = []
    """Faults of the bus and of the nodes on it."""
    sensor_fault: list[SensorFault] = []
    """Faults of the position sensor."""
    temperature_fault: list[TemperatureFault] = []
    """Faults of the thermometer in the position sensor."""
    speed_fault: list[SpeedFault] = []
    """Faults of the shaft speeds that the plant reports."""
    valve_fault: list[ValveFault] = []
    """Faults of the valves."""
    effects: list[str] = []
    """Python files of a user's own effects, relative to the scenario; a result.json holds them with
    the hash of their content, and runs again with the same content only."""
    model_set: str = "nominal"
    """Parameter set of the plant: a shipped name, or a model file relative to the scenario."""
    model: dict[str, float | list[float]] = {}
    """Parameters of the plant that differ from the set, by path, e.g. "valve.D_fall" = 0.02, and
    effects to add, by effect.ID.PARAMETER."""
    trace_period_s: Annotated[float, Meta(ge=1e-5, le=1.0)] = 0.0005
    """Distance of the rows of trace.csv; at most a tenth of duration_s."""
    expect: Expectations = Expectations()


def expanded(scenario: Scenario) -> dict[str, Any]:
    """Return every value of a scenario, defaults included, as plain tables and lists."""
    table: dict[str, Any] = json.loads(json.dumps(msgspec.to_builtins(scenario)))
    return table


def contradictions(scenario: Scenario) -> list[str]:
    """Return a line for each pair of values that each are allowed and together are likely wrong."""
    sent_s, assumed_s = scenario.sensor.period_s, scenario.controller.sensor.period_s
    if sent_s == assumed_s:
        return []
    return [
        f"controller.sensor.period_s is {quantity(assumed_s, 's')}, but the sensor sends every "
        f"{quantity(sent_s, 's')} (sensor.period_s): the firmware's filter and limits are designed "
        f"for the wrong rate; set sensor.period_s alone, which sets both"
    ]


def check_consistent(scenario: Scenario, source: str) -> None:
    """Check what involves several values.  Raises InputError with the first error."""
    for line in _inconsistencies(scenario):
        raise InputError(f"{source}: {line}")
    try:
        FaultPlan(scenario.fault, scenario.seed)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _inconsistencies(scenario: Scenario) -> Iterator[str]:
    if not scenario.name.isprintable():  # pictures, pages and JUnit files hold the name
        name = one_line(scenario.name)
        yield f"name: {name!r}; expected printable characters only"
    last, end = -1.0, scenario.duration_s
    for index, request in enumerate(scenario.request):
        key = f"request[{index}].at_s: {request.at_s}"
        if request.at_s <= last:
            yield f"{key}; expected later than the one before, {last}"
        if request.at_s >= end:
            yield f"{key}; expected before the end, {end} s"
        last = request.at_s
    if scenario.trace_period_s > 0.1 * end:
        expected = f"expected at most a tenth of duration_s, {0.1 * end:g} s"
        yield f"trace_period_s: {scenario.trace_period_s}; {expected}"
    if scenario.bus.extra_load > 0.95 and scenario.bus.send_buffer is None:
        why = f"more waits than can be sent with extra_load {scenario.bus.extra_load:g}"
        yield f"bus.send_buffer: missing; expected a number of frames, since {why}"
    if scenario.controller.ns_per_instruction and not in_module(scenario.firmware):
        why = "only the instructions of a firmware in C are counted"
        yield f"controller.ns_per_instruction: given; expected none, since {why}"
    if scenario.vehicle is not None:
        if scenario.driver != DriverTable():
            yield "driver: given; expected none with [vehicle], which has its own periods"
        gears = scenario.vehicle.gear_backward, scenario.vehicle.gear_forward
        if 0 in gears or gears[0] == gears[1]:
            yield f"vehicle.gear_backward, gear_forward: {gears[0]}, {gears[1]}; expected two different gears, none of them 0"
    yield from _impossible_limits(scenario.expect)
    if len(set(scenario.plant.charged)) != len(scenario.plant.charged):
        yield "plant.charged: a chamber twice; expected each once"
    for name in FAULT_TABLES[1:]:  # a FaultPlan checks the first one
        for index, fault in enumerate(getattr(scenario, name)):
            if fault.end_s is not None and fault.end_s <= fault.start_s:
                key = f"{name}[{index}].end_s: {fault.end_s}"
                yield f"{key}; expected after its start, {fault.start_s} s"


def _impossible_limits(expect: Expectations) -> Iterator[str]:
    named = [
        (f"expect.{table}.{name}", each.min, each.max)
        for table in ("metrics", "lockstep")
        for name, each in getattr(expect, table).items()
    ]
    named += [(f"expect.timing[{k}]", t.min_s, t.max_s) for k, t in enumerate(expect.timing)]
    for key, low, high in named:
        if low is None and high is None:
            yield f"{key}: neither a smallest nor a largest value; expected one of them"
        elif low is not None and high is not None and low > high:
            yield f"{key}: from {low} to {high}; expected the smallest value first"


def scenario_toml(scenario: Scenario) -> str:
    """Return the text of a file that loads as this scenario, without its expectations."""
    defaults = expanded(Scenario(name="-", duration_s=1.0, request=[]))
    table = _different(expanded(scenario), defaults)
    table.pop("expect", None)
    for key in ("name", "duration_s", "request"):
        table[key] = expanded(scenario)[key]
    return "\n".join(_lines(table, "")) + "\n"


def _different(table: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    differences: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict) and isinstance(defaults.get(key), dict):
            if inner := _different(value, defaults[key]):
                differences[key] = inner
        elif value is not None and (key not in defaults or value != defaults[key]):
            differences[key] = _without_none(value)
    return differences


def _without_none(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_none(item) for item in value]
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return value


def _lines(table: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """Yield the lines of a table: its values, then its tables."""
    inner: list[tuple[str, Any]] = []
    for key, value in table.items():
        name = key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)
        tables = value if isinstance(value, list) else [value]
        if tables and all(isinstance(item, dict) for item in tables):
            inner.append((prefix + name, value))
        else:
            yield f"{name} = {toml_value(value)}"
    for name, value in inner:
        for item in value if isinstance(value, list) else [value]:
            yield ""
            yield f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
            yield from _lines(item, f"{name}.")
