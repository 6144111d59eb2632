"""Show the transports found on this machine, and load and worst-case response times of a bus.

Without --dbc it is the project's own contract; with a scenario, the periods are that scenario's; with
--log, periods and jitter are those measured in the log, and --dbc gives the names.

example:
  opc4 bus --bitrate 250000
  opc4 bus --dbc > opc4.dbc
  opc4 bus --dbc truck.dbc --log monday.asc --channel 1 --bitrate 250000
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError
from sil.cli.options import JSON, SELECTION, argument
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.coupling.response_times import PeriodicMessage


ARGUMENTS = (
    argument(
        "--dbc",
        "another database [the project's]; without FILE: print the project's database",
        "FILE",
        nargs="?",
        const="",
    ),
    argument("--scenario", "take periods and bit rate from it", "SCENARIO"),
    argument(
        "--log", "measure periods and jitter in it; repeatable", "LOG", action="append", default=[]
    ),
    *(option for option in SELECTION if option[0] in ("--since", "--until", "--channel")),
    argument("--bitrate", "[500000]", "BIT/S", type=int),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Print; return 1 if a message may be too late.  Raises InputError for bad input."""
    from can_dbc.contract import DBC_PATH
    from sil.coupling import response_times
    from sil.coupling.clock import to_seconds

    if arguments.dbc == "":  # without FILE
        text = Path(DBC_PATH).read_text(encoding="ascii")
        print(json.dumps({"dbc": text}) if arguments.json else text.removesuffix("\n"))
        return 0
    if arguments.scenario and (arguments.dbc or arguments.log):
        raise InputError("--scenario: given with --dbc or --log; expected one of them")
    for option in ("since", "until", "channel"):
        if getattr(arguments, option) and not arguments.log:
            raise InputError(f"--{option}: given without --log; expected both")
    bitrate = 500_000
    notes: list[str] = []
    if arguments.log:
        messages, notes = _measured(arguments)
    elif arguments.dbc:
        from can_dbc.dbc import load_dbc

        messages = response_times.database_messages(load_dbc(arguments.dbc), arguments.dbc)
    elif arguments.scenario:
        from sil.simulation import load_scenario
        from sil.simulation.bus_figures import scenario_messages

        loaded = load_scenario.load(arguments.scenario).scenario
        bitrate, messages = loaded.bus.bitrate, scenario_messages(loaded)
    else:
        messages = response_times.contract_messages()
    bitrate = bitrate if arguments.bitrate is None else arguments.bitrate
    responses = response_times.response_times(messages, bitrate)
    figures: dict[str, Any] = {
        "transports": _transports(),
        "bitrate": bitrate,
        "notes": notes,
        "worst_case_load": float(response_times.utilisation(messages, bitrate)),
        "messages": [
            {
                "name": r.message.name,
                "can_id": f"{r.message.can_id:08X}",
                "period_s": to_seconds(r.message.period_ns),
                "jitter_s": to_seconds(r.message.jitter_ns),
                "transmission_s": to_seconds(r.transmission_ns),
                "blocking_s": to_seconds(r.blocking_ns),
                "worst_case_s": to_seconds(r.response_ns),
                "deadline_s": to_seconds(r.message.period_ns),
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


def _measured(arguments: argparse.Namespace) -> tuple[tuple[PeriodicMessage, ...], list[str]]:
    """Return the messages of a log, and what is assumed; periods that the DBC states go first."""
    from can_dbc.dbc import load_dbc
    from sil.coupling.response_times import PeriodicMessage
    from sil.j1939.periods import measure_bus, names_of
    from sil.logs import Selection, open_logs

    since, until = arguments.since, arguments.until
    chosen = Selection.parse(since=since, until=until, channels=arguments.channel)
    log = open_logs(arguments.log, selection=chosen, show_progress=True)
    measured, left_out = measure_bus(log, log.path)
    names: dict[tuple[int, bool], str] = {}
    stated: dict[tuple[int, bool], int] = {}
    how = "jitter of 99 % of the intervals, waiting for the bus included"
    notes = [f"periods and jitter measured in {log.path} ({how})", *left_out]
    if arguments.dbc:
        database = load_dbc(arguments.dbc)
        names = names_of(database, measured)
        stated = {
            (m.frame_id, m.is_extended_frame): round(m.cycle_time * 1e6)
            for m in database.messages
            if m.cycle_time
        }
        if unnamed := len(measured) - len(names):
            unnamed_text = counted(unnamed, "message")
            notes.append(f"{unnamed_text} not in {arguments.dbc}, shown by identifier")
    messages = []
    for message in measured:
        key = message.can_id, message.extended
        name = names.get(key, f"{message.can_id:0{8 if message.extended else 3}X}")
        name += "" if message.periodic or key in stated else " ~"
        figures = stated.get(key, message.period_ns), message.length, message.jitter_ns
        messages.append(PeriodicMessage(name, message.can_id, *figures, extended=message.extended))
    return tuple(messages), notes


def _transports() -> dict[str, Any]:
    """Return what a run can use here: always one process, and what the system has."""
    from sil.coupling.transports.address import running_channels

    kinds = Path("/sys/class/net").glob("*/type")  # 280: ARPHRD_CAN
    interfaces = sorted(kind.parent.name for kind in kinds if kind.read_text().strip() == "280")
    return {"inproc": True, "local": True, "local_runs": running_channels(), "can": interfaces}


def _print(figures: dict[str, Any]) -> None:
    transports = figures["transports"]
    print("transports: inproc, local" + "".join(f", {name}" for name in transports["can"]))
    if not transports["can"]:
        print("  no CAN interface on this machine")
    for name in transports["local_runs"]:
        print(f"  a run listens on local:{name}")
    percent = 100 * figures["worst_case_load"]
    print(f"bus: {figures['bitrate']} bit/s, {percent:.1f} % loaded at worst")
    for note in figures["notes"]:
        print(f"  {note}")
    width = max(18, *(len(m["name"]) for m in figures["messages"]))
    print(
        f"  {'message':<{width}} {'identifier':>10} {'period ms':>10} {'jitter ms':>10} {'frame ms':>9} "
        f"{'blocked ms':>11} {'worst ms':>9}"
    )
    for m in figures["messages"]:
        late = "" if m["in_time"] else "  too late"
        print(
            f"  {m['name']:<{width}} {m['can_id']:>10} {1e3 * m['period_s']:>10.1f} "
            f"{1e3 * m['jitter_s']:>10.3f} "
            f"{1e3 * m['transmission_s']:>9.3f} {1e3 * m['blocking_s']:>11.3f} "
            f"{1e3 * m['worst_case_s']:>9.3f}{late}"
        )
