"""Run one participant of a scenario alone: it joins a run begun with `opc4 run --external`.

The channel is local:NAME (printed by `opc4 run`) or a CAN interface.  File or name of the scenario,
and settings, must be those of the run.
"""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from sil.cli.options import MODEL, SEED, SETTINGS, argument, say

EXAMPLE = """\
example:
  opc4 node controller --channel vcan0 --scenario full_shift
"""

WAIT_S = 300.0
"""The first start on a machine compiles the plant's equations."""


ARGUMENTS = (
    argument("participant", "who takes part", choices=("plant", "controller")),
    argument("--channel", "where the run is", "local:NAME|INTERFACE", required=True),
    argument("--scenario", "file or shipped name", "SCENARIO", default="full_shift"),
    SEED,
    argument(
        "--timeout",
        f"how long to wait for the run [{WAIT_S:g}]",
        "SECONDS",
        type=float,
        default=WAIT_S,
    ),
    argument("--out", "where the plant records [.]", "DIR", type=Path, default=Path()),
    argument("--force", "replace the records in DIR"),
    *(MODEL, SETTINGS),
)


def run(arguments: argparse.Namespace) -> int:
    """Take part in the run.  Raises InputError for bad input, RunError when the run ends early."""
    from can_dbc.errors import InputError
    from sil.coupling.transports.link import open_link, take_part
    from sil.files.output_folder import without_parent_steps
    from sil.recording.recorder import EVENTS, PLANT_TRACE
    from sil.simulation import build, scenario

    wait_s: float = arguments.timeout
    if not 0.0 <= wait_s <= 86400.0:
        raise InputError(f"--timeout: {wait_s}; expected 0 to 86400 s")

    def notify(message: str) -> None:
        say(f"opc4 node: {message}")

    loaded = scenario.load(
        arguments.scenario,
        model=arguments.model,
        settings=arguments.settings,
        seed=arguments.seed,
    )
    out = without_parent_steps(arguments.out)
    if arguments.participant == "plant" and not arguments.force:
        for name in (PLANT_TRACE, EVENTS):
            if (out / name).exists():
                raise InputError(f"{out / name}: exists; expected none, or --force")
    with contextlib.ExitStack() as undoing:
        link = open_link(arguments.channel, wait_s, notify)
        undoing.callback(link.close)
        if arguments.participant == "plant":
            out.mkdir(parents=True, exist_ok=True)
        participant = build.make_participant(arguments.participant, loaded, out)
        undoing.pop_all()  # take_part closes both
        number = build.scenario_number(loaded.scenario)
        take_part(participant, link, scenario=number, start_timeout_s=wait_s, say=notify)
    return 0
