"""Open a live bench in the browser: shifts by hand, what-ifs, the bus, finished runs.

The page is served to this machine only, at an address with a token. Further scenario files can be
given; the shipped ones are always there. Ends with Ctrl-C.

example:
  opc4 live
  opc4 live my_scenario.toml --runs results --no-browser --port 8000
  opc4 live --firmware own.c
"""

from __future__ import annotations

import argparse
from pathlib import Path

from can_dbc.errors import InputError
from sil.cli.options import argument, say

ARGUMENTS = (
    argument("scenarios", "further scenario files", "SCENARIO", nargs="*"),
    argument("--firmware", "a firmware of your own, as of opc4 run", "FILE", default=""),
    argument("--port", "port on 127.0.0.1; 0: any free one [0]", "N", type=int, default=0),
    argument("--runs", "folder of the finished runs that are shown [runs]", "DIR", type=Path),
    argument("--no-browser", "print the address only"),
)


def run(arguments: argparse.Namespace) -> int:
    """Serve until interrupted. Raises InputError for a port in use, a scenario or firmware that is not valid."""
    import asyncio
    import signal
    import webbrowser

    from can_dbc.user_file import resolved
    from sil.firmware.load import firmware_node
    from sil.live.server import Bench, serve
    from sil.simulation import build, load_scenario

    if not 0 <= arguments.port <= 65535:
        raise InputError(f"--port {arguments.port}: expected 0 to 65535")
    scenarios = {name: name for name in load_scenario.shipped()}
    for file in arguments.scenarios:
        scenarios[load_scenario.load(file).scenario.name] = file
    folder = arguments.runs or Path("runs")
    if arguments.runs is not None and not folder.is_dir():
        raise InputError(f"{folder}: --runs: no such folder; expected one that exists")
    if arguments.firmware:
        checked = load_scenario.load("lab_n_b", settings={"firmware": arguments.firmware}).scenario
        firmware_node(checked.firmware, checked.controller).close()

    def log(line: str) -> None:
        say(f"opc4 live: {line}")

    shared = Bench(scenarios, resolved(folder), log=log, firmware=arguments.firmware)

    def ready(address: str) -> None:
        print(address, flush=True)
        log("ends with Ctrl-C")
        shared.pool.submit(lambda: build.warm_up(load_scenario.load("lab_n_b")))
        if not arguments.no_browser:
            webbrowser.open(address)

    async def until_ended() -> None:
        # by the loop: a signal just before the loop begins to wait would not wake it otherwise
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                loop.add_signal_handler(number, task.cancel)
        await serve(shared, arguments.port, ready)

    try:
        asyncio.run(until_ended())
    except (KeyboardInterrupt, asyncio.CancelledError):
        log("ended")
    return 0
