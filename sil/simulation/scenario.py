"""Scenarios as typed TOML: every value has a name, bounds and a default, and can be overridden."""

from __future__ import annotations

import contextlib
import copy
import functools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, Unpack

import msgspec
from msgspec import Meta

from can_dbc import typed_toml
from can_dbc.errors import InputError, nearest, unknown_name
from controller.config import FirmwareConfig
from plant.devices.driveline import DrivelineConfig
from plant.devices.position_circuit import SensorConfig, SensorFault
from plant.devices.signal_faults import SpeedFault, TemperatureFault
from plant.devices.valve import CoilConfig, Drive
from plant.devices.valve_driver import ValveDriverConfig
from plant.devices.valve_faults import ValveFault
from sil.coupling.faults import BusFault, FaultPlan
from sil.files import overrides
from sil.files.quantity import quantity
from sil.nodes.own_firmware import absolute
from sil.nodes.vehicle import VehicleConfig
from sil.simulation.expectations import ChamberName, Expectations, GearName
from sil.simulation.unit_memory import embedded

if TYPE_CHECKING:
    from plant.parameters import ParameterSet

SHIPPED = Path(__file__).parent / "scenarios"

FAULT_TABLES = ("fault", "sensor_fault", "temperature_fault", "speed_fault", "valve_fault")

Seconds = Annotated[float, Meta(ge=0.0, le=86400.0)]
Newtons = Annotated[float, Meta(ge=0.0, le=1e5)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a scenario file; unknown names are refused."""


class Request(_Table, frozen=True, kw_only=True):
    """A gear that the driver requests."""

    at_s: Seconds
    """Time from which the driver requests the gear, until the next request."""
    gear: GearName
    """The gear requested."""


class PlantTable(_Table, frozen=True, kw_only=True):
    """Conditions of the actuator: where it is mounted, what it is fed with, what resists it."""

    mounted: bool = False
    """Mounted on the gearbox, with its masses, teeth and synchronizer; otherwise in the lab."""
    supply_pressure_pa: Annotated[float, Meta(ge=1e5, le=2e6)] | None = None
    """Supply pressure, absolute; if left out, the model's supply.P_s."""
    charged: list[ChamberName] = []
    """Chambers at supply pressure at the start; the others are at atmospheric pressure."""
    damper: Literal["none", "incompressible", "compressible"] = "none"
    """Oil damper on the stay, and how its oil is modelled."""
    mesh_force_n: Newtons = 0.0
    """Peak of the force against meshing, on the way into a gear."""
    pull_force_n: Newtons = 0.0
    """Peak of the force that holds the teeth, on the way out of a gear."""
    drive: Drive = "delays"
    """Valves as time delays, or with the current of their coils (see [coil])."""
    closing_follows_duty: bool = False
    """A valve closes sooner after a smaller duty; with drive = "delays"."""
    speeds_period_s: Annotated[float, Meta(ge=0.001, le=0.02)] = 0.01
    """Period of the DrivelineSpeeds frames."""
    truth_period_s: Annotated[float, Meta(ge=0.001, le=1.0)] = 0.01
    """Period of the frames that carry the true motion and pressures."""


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


class ClockTable(_Table, frozen=True, kw_only=True):
    """Clocks that run faster or slower than simulated time."""

    controller_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """How much faster than simulated time the controller's clock runs, in millionths."""
    driver_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """The same for the driver's clock."""


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
    plant: PlantTable = PlantTable()
    driveline: DrivelineConfig = DrivelineConfig()
    valve_driver: ValveDriverConfig = ValveDriverConfig()
    coil: CoilConfig = CoilConfig()
    sensor: SensorConfig = SensorConfig()
    controller: FirmwareConfig = FirmwareConfig()
    firmware: str = ""
    """FILE.py or FILE.py:CLASS of a user's own firmware in place of ours, or the folder of another
    checkout of this project with its firmware, relative to the scenario; empty for ours."""
    memory: str = ""
    """Memory with which our firmware is powered on: a file of at most 4096 bytes, relative to the
    scenario, as the memory.bin that a run with a learning strategy leaves; empty for none. A
    result.json holds the content."""
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


@dataclass(frozen=True)
class Loaded:
    """A scenario with its model parameters, overrides applied."""

    scenario: Scenario
    parameters: ParameterSet
    source: str


def shipped() -> dict[str, Path]:
    """Return the scenarios that come with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


class Overrides(TypedDict, total=False):
    """What replaces values of a scenario file."""

    model: str | None
    """Parameter set or model file of the plant."""
    settings: Sequence[str]
    """Texts PATH=VALUE; PATH names a value of the scenario, the firmware (controller...), sensor,
    bus, or model (valve.D_fall)."""
    effects: Sequence[str]
    """Files of a user's own effects."""
    seed: int | None
    """Seed of all random numbers."""


def load(where: str, **given: Unpack[Overrides]) -> Loaded:
    """Load a scenario file, or a shipped scenario by name, and apply overrides.

    A result.json is loaded as the scenario that it holds.
    Raises InputError naming file and key, what is wrong and what was expected.
    """
    table, path = read(where)
    return from_table(table, str(path), folder=path.parent, **given)


def read(where: str) -> tuple[dict[str, Any], Path]:
    """Return a scenario file, or a shipped scenario by name, as parsed, and its path."""
    path = find(where)
    return _read(path), path


def from_table(
    table: Mapping[str, Any], source: str, *, folder: Path = Path(), **given: Unpack[Overrides]
) -> Loaded:
    """Build a scenario from a parsed file; `source` names it, `folder` holds its model files.

    Raises InputError as `load` does.
    """
    model, seed = given.get("model"), given.get("seed")
    settings, effects = given.get("settings", ()), given.get("effects", ())
    raw = copy.deepcopy(dict(table))
    scenario = _checked(raw, source)
    if model is not None:
        raw["model_set"] = model
    elif scenario.model_set.endswith(".toml"):
        raw["model_set"] = str(folder / scenario.model_set)
    if scenario.firmware:
        raw["firmware"] = absolute(scenario.firmware, folder)
    if scenario.memory:
        raw["memory"] = embedded(scenario.memory, folder, source)
    if scenario.effects or effects:
        from plant.effects.user_file import load_effects

        files = [str(folder / file) for file in scenario.effects] + list(effects)
        raw["effects"] = list(dict.fromkeys(load_effects(file) for file in files))
    parameters = _parameters(raw.get("model_set", scenario.model_set), source)
    if settings or seed is not None:
        for text in settings:
            _apply(raw, text, parameters)
        if seed is not None:
            raw["seed"] = seed
        typed_toml.refuse_not_finite(raw, "--set")
        scenario = _checked(raw, "--set")
        if scenario.firmware:
            raw["firmware"] = absolute(scenario.firmware, Path())
        if scenario.memory:
            raw["memory"] = embedded(scenario.memory, Path(), "--set")
    scenario = typed_toml.convert(raw, Scenario, source)
    _check_consistent(scenario, source)
    return Loaded(scenario, _overridden(parameters, scenario.model, source), source)


def expanded(scenario: Scenario) -> dict[str, Any]:
    """Return every value of a scenario, defaults included, as plain tables."""
    found: dict[str, Any] = msgspec.to_builtins(scenario)
    return found


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


def find(where: str) -> Path:
    """Return the file of a scenario given by path or by shipped name. Raises InputError."""
    path = Path(where)
    with contextlib.suppress(OSError, ValueError):  # a name too long, or with a null byte
        if path.is_file():
            return path
    known = shipped()
    if where in known:
        return known[where]
    if "/" in where or where.endswith((".toml", ".json")):
        raise InputError(f"{typed_toml.one_line(where)}: file: not found; expected a scenario")
    raise InputError(f"{typed_toml.one_line(where)}: scenario: {unknown_name(where, known)}")


def _read(path: Path) -> dict[str, Any]:
    if path.suffix != ".json":
        return typed_toml.read_toml(path)
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        table = held["scenario"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: file: no scenario in it; expected a result.json") from None
    if not isinstance(table, dict):
        raise InputError(f"{path}: scenario: not a table; expected that of a result.json")
    return table


def _checked(raw: dict[str, Any], source: str) -> Scenario:
    """Rewrite the short forms in place: filter = false, [model.valve] D_fall; return the scenario.

    One sensor period is both the sensor's and the firmware's; the gears and ratios of [vehicle] become
    those of plant and controller.
    """
    controller = raw.get("controller")
    if isinstance(controller, dict) and isinstance(controller.get("filter"), bool):
        controller["filter"] = {"enabled": controller["filter"]}
    if isinstance(model := raw.get("model"), dict):
        raw["model"] = dict(_flat(model, source, ""))
    scenario = typed_toml.convert(raw, Scenario, source)
    if "period_s" in raw.get("sensor", {}):
        _inside(raw, "controller", "sensor")["period_s"] = raw["sensor"]["period_s"]
    if vehicle := raw.get("vehicle"):
        ratios = {key: vehicle[key] for key in vehicle if key.startswith("ratio_")}
        gears = {key: vehicle[key] for key in vehicle if key.startswith("gear_")}
        driveline, broadcast = _inside(raw, "driveline"), _inside(raw, "controller", "broadcast")
        driveline.update({"follows_requests": True} | driveline | ratios)
        broadcast.update({"etc2_period_s": 0.1} | broadcast | ratios | gears)
    return scenario


def _inside(raw: dict[str, Any], *keys: str) -> Any:
    """Return the table inside tables that is reached by keys, each made if missing."""
    for key in keys:
        raw = raw.setdefault(key, {})
    return raw


def _flat(table: Mapping[str, Any], source: str, prefix: str) -> Iterable[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            if prefix.count(".") > 3:
                inside = typed_toml.one_line(f"model.{prefix}{key}")
                raise InputError(f"{source}: {inside}: nested too deeply; expected section.key")
            yield from _flat(value, source, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _parameters(model_set: str, source: str) -> ParameterSet:
    try:
        return _nominal() if model_set == "nominal" else _load(model_set)
    except InputError as error:
        raise InputError(f"{source}: model_set: {typed_toml.one_line(str(error))}") from None


def _load(model_set: str) -> ParameterSet:
    from plant.parameters import load as load_parameters

    return load_parameters(model_set)


@functools.cache
def _nominal() -> ParameterSet:
    """Return the set that every scenario starts from, which cannot be changed and is read once."""
    return _load("nominal")


def _overridden(
    parameters: ParameterSet, changes: Mapping[str, float | list[float]], source: str
) -> ParameterSet:
    try:
        if any(path.startswith("effect.") for path in changes):
            from plant.effects import overridden

            return overridden(parameters, changes)
        return parameters.override(changes)
    except InputError as error:
        raise InputError(f"{source}: model: {error}") from None


def _apply(raw: dict[str, Any], text: str, parameters: ParameterSet) -> None:
    """Apply one PATH=VALUE to the raw scenario."""
    path, value = overrides.parse_setting(text)
    if path in parameters or path.startswith("effect."):
        raw.setdefault("model", {})[path] = value
        return
    if path == "controller.filter" and isinstance(value, bool):
        path = "controller.filter.enabled"
    if path.startswith(_STRATEGY) and _set_strategy(raw, path.removeprefix(_STRATEGY), value):
        return
    if not overrides.set_value(raw, Scenario, path, value):
        known = [*overrides.leaf_paths(Scenario, raw), *parameters]
        near = nearest(path, known, 5, 0.4) or ["valve.D_fall", "controller.period_s"]
        raise InputError(
            f"--set {typed_toml.one_line(path)}: no such value; nearest: {', '.join(near)}"
        )


_STRATEGY = "controller.strategy_parameters."


def _set_strategy(raw: dict[str, Any], path: str, value: Any) -> bool:
    """Set a strategy's own setting, nested ones too; the firmware refuses names it does not have."""
    *tables, name = path.split(".")
    try:
        at = _inside(raw, "controller", "strategy_parameters", *tables)
    except AttributeError:  # a value, not a table
        return False
    if not isinstance(at, dict) or not name or "" in tables:
        return False
    at[name] = value
    return True


def _check_consistent(scenario: Scenario, source: str) -> None:
    """Check what involves several values.  Raises InputError with the first contradiction."""
    for line in _inconsistencies(scenario):
        raise InputError(f"{source}: {line}")
    try:
        FaultPlan(scenario.fault, scenario.seed)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _inconsistencies(scenario: Scenario) -> Iterator[str]:
    if not scenario.name.isprintable():  # pictures, pages and JUnit files hold the name
        name = typed_toml.one_line(scenario.name)
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
        yield (
            f"trace_period_s: {scenario.trace_period_s}; expected at most a tenth of duration_s, "
            f"{0.1 * end:g} s"
        )
    if scenario.bus.extra_load > 0.95 and scenario.bus.send_buffer is None:
        yield (
            "bus.send_buffer: missing; expected a number of frames, since more waits than can be "
            f"sent with extra_load {scenario.bus.extra_load:g}"
        )
    if scenario.memory and (scenario.firmware or not scenario.controller.learns):
        yield "memory: given; expected none unless controller.strategy learns"
    if scenario.vehicle is not None and scenario.driver != DriverTable():
        yield "driver: given; expected none with [vehicle], which has its own periods"
    if len(set(scenario.plant.charged)) != len(scenario.plant.charged):
        yield "plant.charged: a chamber twice; expected each once"
    for name in FAULT_TABLES[1:]:  # a FaultPlan checks the first one
        for index, fault in enumerate(getattr(scenario, name)):
            if fault.end_s is not None and fault.end_s <= fault.start_s:
                key = f"{name}[{index}].end_s: {fault.end_s}"
                yield f"{key}; expected after its start, {fault.start_s} s"
