"""Run one participant of a scenario alone, on a bus.

In lockstep it joins a run begun with `opc4 run --external`; file or name of the scenario, and
settings, must be those of the run.  With --realtime it runs by the wall clock with any other nodes,
which may join and leave; Ctrl-C ends it.  The channel is local:NAME (printed by
`opc4 run`) or a CAN interface; with --realtime also one of python-can, as pcan:PCAN_USBBUS1.

example:
  opc4 node controller --channel vcan0 --scenario full_shift
  opc4 node controller --channel vcan0 --realtime
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import threading
from pathlib import Path

from can_dbc.errors import InputError
from sil.cli.options import MODEL, SEED, SETTINGS, argument, say

ARGUMENTS = (
    argument("participant", "who takes part", choices=("plant", "controller")),
    argument("--channel", "where the run is", "local:NAME|INTERFACE", required=True),
    argument("--scenario", "file or shipped name", "SCENARIO", default="full_shift"),
    SEED,
    argument(
        "--timeout",
        "how long to wait for the run [300]",
        "SECONDS",
        type=float,
        default=300.0,  # the first start on a machine compiles the plant's equations
    ),
    argument("--out", "where the plant records [.]", "DIR", type=Path, default=Path()),
    argument("--force", "replace the records in DIR"),
    argument(
        "--realtime",
        "run by the wall clock with any nodes on the bus, without the coordinator of a run",
    ),
    argument("--duration", "with --realtime: end after this time [Ctrl-C]", "SECONDS", type=float),
    *(MODEL, SETTINGS),
)


def run(arguments: argparse.Namespace) -> int:
    """Take part in the run.  Raises InputError for bad input, RunError when the run ends early."""
    from sil.coupling.free_running import FreeNode, open_bus
    from sil.coupling.transports.link import open_link, take_part
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import without_parent_steps
    from sil.recording.recorder import CLOCK_ZERO, EVENTS, PLANT_TRACE
    from sil.simulation import build, load_scenario

    wait_s: float = arguments.timeout
    if not 0.0 <= wait_s <= 86400.0:
        raise InputError(f"--timeout: {wait_s}; expected 0 to 86400 s")

    def notify(message: str) -> None:
        say(f"opc4 node: {message}")

    model, settings, seed = arguments.model, arguments.settings, arguments.seed
    loaded = load_scenario.load(arguments.scenario, model=model, settings=settings, seed=seed)
    duration_s: float | None = arguments.duration
    if duration_s is not None and not (arguments.realtime and 0.0 < duration_s <= 86400.0):
        raise InputError(f"--duration: {duration_s}; expected 0 to 86400 s, and --realtime")
    out = without_parent_steps(arguments.out)
    if arguments.participant == "plant" and not arguments.force:
        for name in (PLANT_TRACE, EVENTS):
            if (out / name).exists():
                raise InputError(f"{out / name}: exists; expected none, or --force")
    name, channel = arguments.participant, arguments.channel

    def started(zero_ns: int) -> None:
        if name == "plant":
            write_atomically(out / CLOCK_ZERO, str(zero_ns))
        notify(f"{name} runs freely on {channel}")

    with contextlib.ExitStack() as closing:
        if arguments.realtime:
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            received = build.received()[name]
            bus = open_bus(channel, wait_s, notify, received, loaded.scenario.bus.bitrate)
            closing.callback(bus.shutdown)
        else:
            link = open_link(channel, wait_s, notify)
            closing.callback(link.close)
        if name == "plant":
            out.mkdir(parents=True, exist_ok=True)
        participant = build.make_participant(name, loaded, out)
        if arguments.realtime:
            closing.callback(participant.close)
            plant = name == "plant"
            node = FreeNode(participant, bus, catches_up=plant, receives=received, on_start=started)
            with contextlib.suppress(KeyboardInterrupt):
                node.run(threading.Event(), duration_s)
            notify(node.report())
        else:
            closing.pop_all()  # take_part closes both
            number = build.scenario_number(loaded.scenario)
            take_part(participant, link, scenario=number, start_timeout_s=wait_s, say=notify)
    return 0
