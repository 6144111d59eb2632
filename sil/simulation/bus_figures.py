"""Load and response times of the bus in a run, with the worst case of each message."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from can_dbc.contract import contract
from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from can_dbc.messages import Fault
from sil.coupling.bus import BusModel
from sil.coupling.clock import to_ns
from sil.coupling.faults import FaultPlan
from sil.coupling.response_times import PeriodicMessage, contract_messages, response_times
from sil.files.quantity import quantity
from sil.j1939.management import NAME_FUNCTIONS, active_faults, address_claim
from sil.j1939.transport import BAM_PERIOD_NS
from sil.nodes.vehicle import PERIODS_NS as VEHICLE_NS
from sil.simulation.scenario import Scenario

COUNTS = ("frames", "error_frames", "lost", "overwritten", "dropped_bus_off", "dropped_full")
_BROADCAST_NS = 10_000_000


def periods_ns(scenario: Scenario) -> dict[str, int]:
    """Return the period of each message that the scenario sets; other periods are those of the DBC."""
    controller = scenario.controller.period_ns
    etc2_ns = to_ns(scenario.controller.broadcast.etc2_period_s)
    return {
        **dict.fromkeys(("ValveCommand", "SafetyBlow", "ControllerStatus"), controller),
        "Etc1": max(_BROADCAST_NS, controller),
        "Etc2": max(etc2_ns, controller),
        "PositionPulse": to_ns(scenario.sensor.period_s),
        "DrivelineSpeeds": to_ns(scenario.plant.speeds_period_s),
        "PlantMotion": to_ns(scenario.plant.truth_period_s),
        "PlantPressures": to_ns(scenario.plant.truth_period_s),
        "ShiftRequest": to_ns(scenario.driver.period_s),
        **({} if scenario.vehicle is None else VEHICLE_NS),
    }


def scenario_messages(scenario: Scenario) -> tuple[PeriodicMessage, ...]:
    """Return the periodic messages of a scenario for the response-time analysis.

    ETC1 and ETC2 jitter by one step of the firmware when it does not divide their period. Of a truck,
    its faults (DM1) and, once a run, its address claims are among them; other nodes' traffic is not.
    """
    step = scenario.controller.period_ns
    jitter = step if step <= _BROADCAST_NS and _BROADCAST_NS % step else 0
    periodic = contract_messages(periods_ns(scenario), dict.fromkeys(("Etc1", "Etc2"), jitter))
    if scenario.vehicle is None:
        return periodic
    claims = [
        PeriodicMessage(f"AddressClaim {source}", address_claim(source).can_id, to_ns(86_400.0))
        for source in NAME_FUNCTIONS
    ]
    faults = PeriodicMessage("DM1", active_faults(Fault.NONE)[0].can_id, BAM_PERIOD_NS)
    return (*periodic, faults, *claims)


def message_rows(
    scenario: Scenario, figures: Callable[[int, int], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return name, sender, period and `figures` (of identifier, period in ns) of each message."""
    messages = contract_messages(periods_ns(scenario))
    return [
        {
            "name": message.name,
            "can_id": f"{message.can_id:08X}",
            "sender": ", ".join(contract()[message.name].senders),
            "period_s": message.period_ns / NS_PER_S,
            "longest_response_s": None,
            "worst_case_s": None,
            **figures(message.can_id, message.period_ns),
        }
        for message in sorted(messages, key=lambda message: message.can_id)
    ]


def bus_figures(scenario: Scenario, bus: BusModel, plan: FaultPlan) -> dict[str, Any]:
    """Return load, counts, and per message: frames, longest response, worst case if not overloaded."""
    statistics = bus.statistics
    longest_s = {can_id: ns / NS_PER_S for can_id, ns in statistics.longest_wait_ns.items()}
    worst_s: dict[int, float] = {}
    with contextlib.suppress(InputError):
        responses = response_times(scenario_messages(scenario), scenario.bus.bitrate)
        worst_s = {each.message.can_id: each.response_ns / NS_PER_S for each in responses}

    def row(can_id: int, period_ns: int) -> dict[str, Any]:
        return {
            "frames": statistics.sent.get(can_id, 0),
            "longest_response_s": longest_s.get(can_id),
            "worst_case_s": worst_s.get(can_id),
        }

    return {
        "bitrate": scenario.bus.bitrate,
        "load": bus.load,
        **{name: getattr(statistics, name) for name in COUNTS},
        "fault_hits": {f"fault[{index}]": hits for index, hits in plan.hits.items()},
        "messages": message_rows(scenario, row),
    }


def overload(figures: dict[str, Any]) -> list[str]:
    """Return a line with the cause when the bus of a run was practically always busy."""
    if figures["load"] < 0.97:
        return []
    fastest_s = min(m["period_s"] for m in figures["messages"])
    names = ", ".join(m["name"] for m in figures["messages"] if m["period_s"] == fastest_s)
    return [
        f"the bus is {100 * figures['load']:.0f} % loaded at {figures['bitrate'] // 1000} kbit/s, so "
        f"frames wait and newer ones overwrite them: {names} are sent every "
        f"{quantity(fastest_s, 's')}; raise bus.bitrate, or the periods of sensor and controller"
    ]
