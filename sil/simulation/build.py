"""Participants made from a scenario, in this process or in processes of their own."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import shlex
import sys
from collections.abc import Callable, Collection, Container, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import msgspec

from can_dbc.contract import contract
from can_dbc.errors import InputError
from can_dbc.messages import Gear
from can_dbc.user_file import resolved
from controller.node import ControllerNode, TickingNode
from sil.coupling.bus import BusModel
from sil.coupling.clock import to_ns
from sil.coupling.faults import FaultPlan, Intrusion
from sil.coupling.lockstep import TURN_ORDER
from sil.coupling.transports.channel import (
    Channel,
    InProcess,
    Participant,
    ParticipantLost,
    Received,
    Timeouts,
    Turn,
)
from sil.coupling.transports.wire import GUEST
from sil.files.extras import ROOT
from sil.nodes.simulated import Drifting, DriverNode, IntruderNode, TrafficNode
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import FAULT_TABLES, Scenario, expanded

if TYPE_CHECKING:
    from plant.node import PlantConfig
    from sil.coupling.transports.remote import RemoteChannel
    from sil.firmware.c_firmware import CController

SCENARIO = "scenario.json"
REMOTE = ("controller", "plant")
"""Participants that have a process of their own on every transport but inproc."""

PARTICIPANT = {
    "Opc4": "controller",
    "ShiftConsole": "driver",
    "Engine": "driver",
    "Pneumatics": "driver",
    "ValveDriver": "plant",
    "PositionSensor": "plant",
    "Driveline": "plant",
}
"""Nodes of the DBC to the participants that send and receive for them."""

SENDERS = (*TURN_ORDER, "traffic", "intruder", GUEST)
"""All who may be on the bus, in the order of their turns."""

TIMEOUTS = Timeouts(start_s=300.0, answer_s=2.0, close_s=5.0)
INITIAL = {"neutral": "N", "backward": "B", "forward": "F"}
Say = Callable[[str], None]


def gear_of(name: str) -> Gear:
    """Return the gear of its name in a scenario."""
    return Gear[name.upper()]


def scenario_number(scenario: Scenario) -> int:
    """Return 32 bits that identify a scenario when a participant joins; never 0."""
    return crc32(json.dumps(expanded(scenario), sort_keys=True).encode()) or 1


def plant_config(scenario: Scenario) -> PlantConfig:
    """Return the plant's settings of a scenario."""
    from plant.node import PlantConfig

    faults: dict[str, Any] = {f"{n}s": tuple(getattr(scenario, n)) for n in FAULT_TABLES[1:]}
    return PlantConfig(
        **msgspec.structs.asdict(scenario.plant),
        **faults,
        initial=INITIAL[scenario.initial_gear],  # type: ignore[arg-type]
        driveline=scenario.driveline,
        valve_driver=scenario.valve_driver,
        coil=scenario.coil,
        sensor=scenario.sensor,
        trace_period_s=scenario.trace_period_s,
        seed=scenario.seed,
    )


def constants(loaded: Loaded) -> dict[str, float]:
    """Return what a record of a run holds besides what was recorded."""
    plant, value = loaded.scenario.plant, loaded.parameters.value
    supply_pa = plant.supply_pressure_pa
    moving = ["length.m_s", "length.m_p", *(["truck.m_gearbox"] if plant.mounted else [])]
    return {
        "supply_pressure_pa": value("supply.P_s") if supply_pa is None else supply_pa,
        "stroke_m": value("length.stroke"),
        "free_travel_m": value("length.x_free_total"),
        "moving_mass_kg": sum(map(value, moving)),
    }


class RecordedPlant:
    """The plant node together with the files that its trace and events go to."""

    name = "plant"

    def __init__(self, loaded: Loaded, folder: Path) -> None:
        from plant.errors import IntegrationError
        from plant.node import PlantNode
        from plant.trace import trace_columns
        from sil.recording.recorder import EVENTS, PLANT_TRACE, EventLog, TraceWriter

        with contextlib.ExitStack() as on_error:
            columns = trace_columns(loaded.scenario.plant.drive)
            trace = on_error.enter_context(TraceWriter(folder / PLANT_TRACE, columns))
            events = on_error.enter_context(EventLog(folder / EVENTS))
            try:
                config = plant_config(loaded.scenario)
                self.node = PlantNode(config, loaded.parameters, trace, events)
                warm_up(loaded)
            except InputError as error:
                raise InputError(f"{loaded.source}: {error}") from None
            except IntegrationError as error:
                raise InputError(f"{loaded.source}: the plant cannot even start: {error}") from None
            self._files = on_error.pop_all()
        self.start = self.node.start

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Advance the plant. Raises ParticipantLost when its motion cannot be continued."""
        from plant.errors import IntegrationError

        try:
            return self.node.advance(until_ns, deliveries)
        except IntegrationError as error:
            raise ParticipantLost("plant", f"could not go on: {error}") from None

    def close(self) -> None:
        """Close the node, which records its balances, then the files."""
        self.node.close()
        self._files.close()


def make_participant(name: str, loaded: Loaded, folder: Path | None) -> Participant:
    """Return one participant of a scenario, its clock as the scenario says.

    Plant and firmware in C record into `folder`; None: no records of the latter. Raises InputError for an
    unknown name, or if the participant refuses its settings.
    """
    participant, clock = _on_time(name, loaded, folder), loaded.scenario.clock
    ppm, start_s = (getattr(clock, f"{name}_{what}", 0.0) for what in ("ppm", "start_s"))
    return Drifting(participant, ppm, round(start_s * 1e9)) if ppm or start_s else participant


def _on_time(name: str, loaded: Loaded, folder: Path | None) -> Participant:
    scenario = loaded.scenario
    if name == "driver":
        schedule = [(to_ns(r.at_s), gear_of(r.gear)) for r in scenario.request]
        driver, initial = scenario.driver, gear_of(scenario.initial_gear)
        if scenario.vehicle is not None:
            from sil.nodes.vehicle import VehicleNode

            supply_pa = constants(loaded)["supply_pressure_pa"]
            return VehicleNode(scenario.vehicle, initial, schedule, supply_pa)
        return DriverNode(initial, schedule, to_ns(driver.period_s), to_ns(driver.phase_s))
    if name == "controller":
        if scenario.firmware:
            from sil.firmware.load import firmware_node

            return firmware_node(scenario.firmware, scenario.controller, folder=folder)
        return ControllerNode(scenario.controller)
    if name == "traffic":
        bus = scenario.bus
        return TrafficNode(bus.extra_load, bus.extra_priority, bus.bitrate, scenario.seed)
    if name == "intruder":
        faults = [fault for fault in scenario.fault if isinstance(fault, Intrusion)]
        return IntruderNode(faults, scenario.bus.bitrate, scenario.seed)
    if name == GUEST:
        expected = "expected opc4 run --transport local:NAME or a CAN interface"
        what = "bus.guest: its program joins over a channel only"
        raise InputError(f"{loaded.source}: {what}; {expected}")
    assert folder is not None
    return RecordedPlant(loaded, folder)


def firmware_in_c(participants: Iterable[Participant]) -> CController | None:
    """Return the control unit whose firmware is in C or WebAssembly; None for one in Python."""
    for participant in participants:
        node = participant.inner if isinstance(participant, Drifting) else participant
        if isinstance(node, TickingNode) and not isinstance(node, ControllerNode):
            from sil.firmware.c_firmware import CController

            assert isinstance(node, CController)
            return node
    return None


def warm_up(loaded: Loaded) -> None:
    """Load (or compile) the plant's kernels now, not within the first turn of a run."""
    import numpy as np

    from plant.systems.length_stroke import LengthStroke

    stroke = LengthStroke(loaded.parameters)
    stroke.advance(1_000_000, [(500_000, 0, 1.0)], np.array([1_000_000], dtype=np.int64))


@functools.cache
def received() -> dict[str, frozenset[int]]:
    """Return the identifiers that each participant of the DBC receives, by its name."""
    return {
        name: frozenset(
            spec.can_id
            for spec in contract().values()
            if name in {PARTICIPANT.get(node) for node in spec.receivers}
        )
        for name in PARTICIPANT.values()
    }


def participant_names(scenario: Scenario) -> tuple[str, ...]:
    """Return who takes part in a scenario."""
    # The guest first: in one process it is refused before others have opened files.
    names = [GUEST] if scenario.bus.guest else []
    names += ["driver", "controller", "plant"]
    if scenario.bus.extra_load > 0.0:
        names.append("traffic")
    if any(isinstance(fault, Intrusion) for fault in scenario.fault):
        names.append("intruder")
    return tuple(names)


def make_bus(scenario: Scenario, plan: FaultPlan) -> BusModel:
    """Return the bus of a scenario, with its faults."""
    specs = contract().values() if scenario.bus.mailboxes else ()
    return BusModel(
        scenario.bus.bitrate,
        frame_filter=plan.frame_filter if plan.touches_frames else None,
        is_off=plan.is_off if plan.touches_frames else None,
        capacity=scenario.bus.send_buffer,
        mailboxes=frozenset(spec.can_id for spec in specs),
    )


def open_channels(
    loaded: Loaded,
    folder: Path,
    transport: str,
    external: Collection[str],
    say: Say,
    closing: contextlib.ExitStack,
) -> list[Channel]:
    """Return the channels to all participants of a run, their processes started.

    `transport`: inproc, local, local:NAME, or a CAN interface; those in `external` are started by the
    user with the command that `say` prints. The plant's process records into `folder`.
    Raises InputError for a transport that this machine does not have, RunError for one in use.
    """
    names = participant_names(loaded.scenario)
    if transport == "inproc":
        if external:
            expected = "expected local or a CAN interface"
            raise InputError(f"--external: not with --transport inproc; {expected}")
        here = [make_participant(name, loaded, folder) for name in names]
        return [InProcess(here, received())]
    if "plant" not in external:
        from plant.kernel.compiled import is_warm

        if not is_warm():  # compiled here, it is announced to the user
            warm_up(loaded)
    number = scenario_number(loaded.scenario)
    remote_names = [*REMOTE, GUEST] if loaded.scenario.bus.guest else REMOTE
    timeouts = TIMEOUTS
    if loaded.scenario.firmware:
        from sil.firmware.python_file import STEP_S

        timeouts = dataclasses.replace(TIMEOUTS, answer_s=STEP_S + TIMEOUTS.answer_s)
    channel, local_name = channel_of(transport)
    opened: type[RemoteChannel]
    if local_name is not None:
        from sil.coupling.transports.hub import Hub as opened
    elif ":" in channel:
        raise InputError(
            f"--transport {transport}: lockstep is for local buses and SocketCAN; expected local, "
            "local:NAME or the name of a CAN interface, or --realtime without --speed"
        )
    else:
        from sil.coupling.transports.socketcan import SocketCan as opened
    where = channel if local_name is None else local_name
    remote = opened(where, remote_names, scenario=number, timeouts=timeouts, say=say)
    closing.callback(remote.close, aborted=True)  # until the coordinator has it
    for name in remote_names:
        if name == GUEST:
            say(f"waiting for guest: start your program on channel {channel}")
        elif command := node_command(name, channel, folder, external, say):
            remote.spawn(name, command)
    here = [make_participant(name, loaded, folder) for name in names if name not in remote_names]
    return [remote, InProcess(here, received())]


def channel_of(transport: str) -> tuple[str, str | None]:
    """Return the channel of a transport, and the name of its local bus; None for a CAN interface."""
    kind, _, name = transport.partition(":")
    if kind != "local":
        return transport, None
    name = f"run-{os.getpid()}" if transport == "local" else name
    return f"local:{name}", name


def node_command(
    name: str,
    channel: str,
    folder: Path,
    external: Container[str] = (),
    say: Say = print,
    *options: str,
) -> list[str]:
    """Return the command that runs one participant of the run in `folder` in its own process.

    Empty for one in `external`: `say` prints it for the user. The process runs this very code.
    """
    folder = resolved(folder) if name in external else folder
    words = ["node", name, "--channel", channel, "--scenario", str(folder / SCENARIO)]
    words += ["--out", str(folder), *(["--force"] if name == "plant" else []), *options]
    if name in external:
        say(f"waiting for {name}: {shlex.join(['opc4', *words])}")
        return []
    path = f"sys.path.insert(0, {str(ROOT)!r})"
    code = f"import sys; {path}; from sil.cli import main; sys.exit(main())"
    return [sys.executable, "-P", "-c", code, *words]
