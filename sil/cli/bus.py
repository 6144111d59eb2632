"""Show the transports found on this machine, and load and worst-case response times of a bus.

Without --dbc it is the project's own contract; with a scenario, the periods are that scenario's.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from sil.cli.options import JSON, argument

EXAMPLE = """\
example:
  opc4 bus --bitrate 250000
  opc4 bus --dbc > opc4.dbc
"""

OWN = ""
"""What `--dbc` is without a FILE."""


ARGUMENTS = (
    argument(
        "--dbc",
        "another database [the project's]; without FILE: print the project's database",
        "FILE",
        nargs="?",
        const=OWN,
    ),
    argument("--scenario", "take periods and bit rate from it", "SCENARIO"),
    argument("--bitrate", "[500000]", "BIT/S", type=int),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Print; return 1 if a message may be too late.  Raises InputError for bad input."""
    from can_dbc.errors import InputError
    from sil.coupling import response_times
    from sil.coupling.clock import to_seconds

    if arguments.dbc == OWN:
        return _print_database(arguments.json)
    if arguments.dbc and arguments.scenario:
        raise InputError("--dbc, --scenario: both given; expected one of them")
    bitrate = 500_000
    if arguments.dbc:
        from can_dbc.dbc import load_dbc

        messages = response_times.database_messages(load_dbc(arguments.dbc))
    elif arguments.scenario:
        from sil.simulation import scenario
        from sil.simulation.bus_figures import scenario_messages

        loaded = scenario.load(arguments.scenario).scenario
        bitrate, messages = loaded.bus.bitrate, scenario_messages(loaded)
    else:
        messages = response_times.contract_messages()
    bitrate = arguments.bitrate or bitrate
    responses = response_times.response_times(messages, bitrate)
    figures: dict[str, Any] = {
        "transports": _transports(),
        "bitrate": bitrate,
        "worst_case_load": float(response_times.utilisation(messages, bitrate)),
        "messages": [
            {
                "name": r.name,
                "can_id": f"{r.can_id:08X}",
                "period_s": to_seconds(r.period_ns),
                "transmission_s": to_seconds(r.transmission_ns),
                "blocking_s": to_seconds(r.blocking_ns),
                "worst_case_s": to_seconds(r.response_ns),
                "deadline_s": to_seconds(r.deadline_ns),
                "in_time": r.in_time,
            }
            for r in responses
        ],
    }
    if arguments.json:
        print(json.dumps(figures, indent=1))
    else:
        _print(figures)
    return 0 if all(r.in_time for r in responses) else 1


def _print_database(as_json: bool) -> int:
    """Print the project's database as it is."""
    from can_dbc.contract import DBC_PATH

    with open(DBC_PATH, encoding="ascii") as file:
        text = file.read()
    print(json.dumps({"dbc": text}) if as_json else text.removesuffix("\n"))
    return 0


def _transports() -> dict[str, Any]:
    """Return what a run can use here: always one process, and what the system has."""
    import socket

    from sil.coupling.transports.address import running_channels

    interfaces = []
    for _, name in socket.if_nameindex():
        try:
            with open(f"/sys/class/net/{name}/type", encoding="ascii") as file:
                if file.read().strip() == "280":  # ARPHRD_CAN
                    interfaces.append(name)
        except OSError:
            continue
    return {"inproc": True, "local": True, "local_runs": running_channels(), "can": interfaces}


def _print(figures: dict[str, Any]) -> None:
    found = figures["transports"]
    print("transports: inproc, local" + "".join(f", {name}" for name in found["can"]))
    if not found["can"]:
        print("  no CAN interface on this machine")
    for name in found["local_runs"]:
        print(f"  a run listens on local:{name}")
    print(
        f"bus: {figures['bitrate']} bit/s, {100 * figures['worst_case_load']:.1f} % loaded at worst"
    )
    print(
        f"  {'message':<18} {'identifier':>10} {'period ms':>10} {'frame ms':>9} "
        f"{'blocked ms':>11} {'worst ms':>9}"
    )
    for m in figures["messages"]:
        late = "" if m["in_time"] else "  too late"
        print(
            f"  {m['name']:<18} {m['can_id']:>10} {1e3 * m['period_s']:>10.1f} "
            f"{1e3 * m['transmission_s']:>9.3f} {1e3 * m['blocking_s']:>11.3f} "
            f"{1e3 * m['worst_case_s']:>9.3f}{late}"
        )
