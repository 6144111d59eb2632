"""Run one participant of a scenario alone: it joins the run that `opc4 run --external` began.

The channel is local:NAME (printed by `opc4 run`) or a CAN interface. The scenario has to be the
same one: file or shipped name and settings."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from sil.cli.options import add_model

EXAMPLE = """\
example:
  opc4 node controller --channel vcan0 --scenario full_shift
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("participant", choices=("plant", "controller"))
    parser.add_argument("--channel", required=True, metavar="local:NAME|INTERFACE")
    parser.add_argument(
        "--scenario", default="full_shift", metavar="SCENARIO", help="file or shipped name"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="seed of everything random")
    parser.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where the plant records [.]"
    )
    parser.add_argument("--force", action="store_true", help="replace records that stand there")
    add_model(parser)


def run(arguments: argparse.Namespace) -> int:
    from can_dbc.errors import InputError
    from sil.coupling.participants import open_link, take_part
    from sil.files.output_folder import without_parent_steps
    from sil.recording.events import EVENTS
    from sil.recording.recorder import PLANT_TRACE
    from sil.simulation import build, scenario

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
                raise InputError(f"{out / name}: stands there; expected none, or --force")
    with contextlib.ExitStack() as undoing:
        link = open_link(arguments.channel, build.PATIENCE.start_s)
        undoing.callback(link.close)
        if arguments.participant == "plant":
            out.mkdir(parents=True, exist_ok=True)
        participant = build.make_participant(arguments.participant, loaded, out)
        undoing.pop_all()  # both are closed by whoever takes part
        take_part(
            participant,
            link,
            scenario=build.scenario_number(loaded.scenario),
            start_timeout_s=build.PATIENCE.start_s,
        )
    return 0
