"""Generate reference pages and diagrams from the code; a test checks that they are up to date.

`python -m docs.generate` writes them: commands, CAN contract, the diagram of the layers.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent


def generated() -> dict[str, str]:
    """Return the text of every generated file by its path in docs/."""
    made = {
        "reference/cli.md": ("Commands", commands()),
        "reference/can.md": ("CAN contract", messages()),
        "reference/keys.md": ("Keys of scenarios and studies", keys()),
        "reference/campaign.md": ("Keys of campaign.toml", campaign_keys()),
        "reference/firmware.md": ("Firmware states", states()),
        "reference/rules.md": ("Rules", rules()),
        "reference/python.md": ("Python", python_api()),
    }
    pages = {
        name: "\n".join([f"# {title}", "", *lines]).rstrip() + "\n"
        for name, (title, lines) in made.items()
    }
    return {**pages, "images/layers.svg": layers_svg(), "images/states.svg": states_svg()}


def layers() -> dict[str, list[list[str]]]:
    """Return the layers of each package, top first, from the import contracts."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    return {
        contract["containers"][0]: [
            [name.strip() for name in row.split("|")] for row in contract["layers"]
        ]
        for contract in contracts
        if contract["type"] == "layers" and "containers" in contract
    }


def layers_svg() -> str:
    """Draw the layers of the packages: each may import those below it in its package."""
    box_height, gap, width = 26, 6, 860
    found = layers()
    parts: list[str] = []

    def column(package: str, x: float, top: float, wide: float) -> float:
        rows = found[package]
        height = 30 + len(rows) * (box_height + gap) + gap
        parts.append(
            f'<rect x="{x}" y="{top}" width="{wide}" height="{height}" rx="6" class="package"/>'
            f'<text x="{x + 12}" y="{top + 20}" class="title">{package}/</text>'
        )
        for number, row in enumerate(rows):
            y = top + 30 + number * (box_height + gap)
            each = (wide - 2 * 12 - (len(row) - 1) * gap) / len(row)
            for index, name in enumerate(row):
                left = x + 12 + index * (each + gap)
                parts.append(
                    f'<rect x="{left:.1f}" y="{y}" width="{each:.1f}" height="{box_height}" rx="4"/>'
                    f'<text x="{left + each / 2:.1f}" y="{y + 18}" class="name">{name}</text>'
                )
        return top + height

    bottom = column("sil", 10, 10, width - 20) + 14
    half = (width - 34) / 2
    below = max(column("plant", 10, bottom, half), column("controller", 24 + half, bottom, half))
    end = column("can_dbc", 10, below + 14, width - 20) + 10
    style = (
        "rect{fill:#f4f7fa;stroke:#7a8b99}.package{fill:#fff;stroke:#33424f;stroke-width:1.5}"
        "text{font:13px sans-serif;fill:#1d2830}.title{font-weight:bold;font-size:15px}"
        ".name{text-anchor:middle}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {end:.0f}" role="img" '
        f'aria-label="Layers of the packages"><style>{style}</style>'
        f'<rect width="{width}" height="{end:.0f}" style="fill:#fff;stroke:none"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def examples() -> dict[str, dict[str, str]]:
    """Return an example for each table: file kind -> table -> TOML text."""
    found: dict[str, dict[str, str]] = tomllib.loads(
        (FOLDER / "key_examples.toml").read_text(encoding="utf-8")
    )
    return found


def keys() -> Iterator[str]:
    """Yield the lines of the page of the keys of scenario, study and replay option files."""
    from docs.key_table import describe
    from sil.log_replay.signals import Options
    from sil.simulation.scenario import Scenario
    from sil.studies.kinds import StudyKind
    from sil.studies.study import StudyFile

    yield "Every key of a file that `opc4 run`, `opc4 whatif` and `opc4 replay --options` take. A key that is not listed"
    yield "is refused. `--set` takes the same paths, e.g. `--set controller.filter.order=4`. Paths of the plant's"
    yield "parameters are those of `plant/parameters/nominal.toml`, e.g. `valve.D_fall`."
    shown = examples()
    study = describe(StudyFile)
    common = {key.key for key in study if not key.table}
    tables_of_all = {key.table for key in study if key.table}
    for record in get_args(StudyKind):
        study += [
            key
            for key in describe(record)
            if key.table not in tables_of_all and not (key.key in common and "kind" in key.table)
        ]
    for title, kind, rows_of in (
        ("Scenario", "scenario", describe(Scenario)),
        ("Study", "study", study),
        ("Options of a replay", "", describe(Options)),
    ):
        yield from ("", f"## {title}", "")
        yield from key_tables(title, rows_of, shown.get(kind, {}))


def key_tables(title: str, rows_of: list[Any], shown: dict[str, str]) -> Iterator[str]:
    """Yield a table of keys for each table of a file, with its example."""
    tables: dict[str, list[Any]] = {}
    for row in rows_of:
        tables.setdefault(row.table.strip(), []).append(row)
    for table, rows in tables.items():
        yield from (f"### {title}: `{table}`" if table else f"### {title}: top level", "")
        yield from ("| key | type | unit | default | range | |", "|---|---|---|---|---|---|")
        for row in rows:
            values = (f"`{row.key}`", row.type, row.unit, f"`{row.default}`", row.range)
            yield f"| {' | '.join(map(cell, values))} | {cell(row.description)} |"
        yield ""
        if example := shown.get(table):
            yield from ("```toml", example.strip(), "```", "")


def campaign_keys() -> Iterator[str]:
    """Yield the lines of the page of the keys of campaign.toml, and of the columns of its files."""
    from docs.key_table import describe
    from sil.campaign.campaign import CampaignTable, ColumnMap
    from sil.campaign.units import COLUMN_UNITS
    from sil.inference.force.record import ForceRig

    yield "A campaign is a folder of measured files and a `campaign.toml`. `opc4 diagnose --new DIR --rig"
    yield 'actuator|fixed|cylinder|force FILES` drafts it; every `"?"` in the draft is a question, and is refused until it is'
    yield "answered. A key that is not listed is refused, too."
    for title, record in (
        ("Strokes of the actuator, its fixed piston, or a cylinder", CampaignTable),
        ("Force and position of a body", ForceRig),
    ):
        yield from ("", f"## {title}", "")
        yield from key_tables(title.split(" ")[0], describe(record), {})
    yield from (
        "## Columns",
        "",
        "Our columns, SI: `time_s`, `position_m` (from neutral, or from the start of a fixed piston),",
    )
    yield "`pressure_B_pa`, `pressure_N_pa`, `pressure_F_pa` or `pressure_1_pa`, `pressure_2_pa`, `pressure_oil2_pa`,"
    yield '`position_internal_m` (as the control unit reports it), `cmd_B` and so on. With `rig = "force"`: `time_s`, `position_m`'
    yield "or `angle_rad`, `force_n` or `torque_n_m`, `pressure_pa`, `pressure_2_pa`. Files with other names or units state each in"
    yield "`[columns]`:"
    yield from ("", "| key | type | unit | default | range | |", "|---|---|---|---|---|---|")
    for row in describe(ColumnMap):
        values = (f"`{row.key}`", row.type, row.unit, f"`{row.default}`", row.range)
        yield f"| {' | '.join(map(cell, values))} | {cell(row.description)} |"
    yield from (
        "",
        "Units that a draft converts, in a name (`x [mm]`) or in a row of their own; a pressure may say what it counts "
        "from (`barg`, `bar ü`, `psia`, `bar abs`):",
        "",
    )
    yield from (
        f"- `{name}`: {', '.join(f'`{unit}`' for unit in units)}"
        for name, units in COLUMN_UNITS.items()
    )


STATES = {
    "INIT": (90, 60),
    "IDLE": (330, 60),
    "PUSH": (570, 60),
    "CONFIRM": (810, 60),
    "FAULT": (90, 300),
    "VENT": (330, 300),
    "HOLD": (570, 300),
    "BLOW": (810, 300),
}
"""Centres of the states in the diagram."""


def transitions() -> dict[tuple[str, str], list[str]]:
    """Return the descriptions of the events that lead from one state to another."""
    from controller.shift import TRANSITIONS

    found: dict[tuple[str, str], list[str]] = {}
    for (state, event), target in TRANSITIONS.items():
        found.setdefault((state.name, target.name), []).append(event.value)
    return found


def states() -> Iterator[str]:
    """Yield the lines of the page of the firmware's states."""
    yield "The firmware carries out a request as a sequence of states. Diagram and table are made from the"
    yield "transition table that the firmware uses (`controller/shift.py`)."
    yield ""
    yield "![States of the firmware](../images/states.svg)"
    yield ""
    yield "| arrow | from | to | event |"
    yield "|---|---|---|---|"
    for number, ((state, target), events) in enumerate(transitions().items(), 1):
        yield f"| {number} | {state} | {target} | {'; '.join(events)} |"


def rules() -> Iterator[str]:
    """Yield the lines of the page of the rules that every run is held to."""
    from sil.rules.shipped import RULES

    yield "They hold in every run of `run`, `whatif`, `swarm`, pytest; `[expect] violated` states those that a fault breaks."
    yield from ("", "| rule | what every run keeps | source |", "|---|---|---|")
    for rule in RULES:
        yield f"| `{rule.name}` | {rule.sentence} | {rule.source} |"


def states_svg() -> str:
    """Draw the states of the firmware; the numbers of the arrows are those of the table."""
    parts = []
    for number, (state, target) in enumerate(transitions(), 1):
        (x0, y0), (x1, y1) = STATES[state], STATES[target]
        if state == target:
            up = -1 if y0 < 180 else 1
            near, far = y0 + up * 20, y0 + up * 62
            path = f"M{x0 - 22},{near} C{x0 - 40},{far} {x0 + 40},{far} {x0 + 22},{near}"
            x, y = x0, y0 + up * 52 + 4
        else:
            length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
            ux, uy = (x1 - x0) / length, (y1 - y0) / length
            bend = 0.11 * length + 4
            cx, cy = (x0 + x1) / 2 - uy * bend, (y0 + y1) / 2 + ux * bend
            (sx, sy), (ex, ey) = edge(x0, y0, cx, cy), edge(x1, y1, cx, cy)
            path = f"M{sx:.0f},{sy:.0f} Q{cx:.0f},{cy:.0f} {ex:.0f},{ey:.0f}"
            x, y = 0.25 * sx + 0.5 * cx + 0.25 * ex, 0.25 * sy + 0.5 * cy + 0.25 * ey + 4
        parts.append(f'<path d="{path}" marker-end="url(#tip)"/>')
        parts.append(
            f'<circle cx="{x:.0f}" cy="{y - 4:.0f}" r="9"/><text x="{x:.0f}" y="{y:.0f}">{number}</text>'
        )
    for name, (x, y) in STATES.items():
        parts.append(
            f'<rect x="{x - 50}" y="{y - 20}" width="100" height="40" rx="8"/>'
            f'<text x="{x}" y="{y + 5}" class="state">{name}</text>'
        )
    style = (
        "path{fill:none;stroke:#56646f}rect{fill:#e8f0f7;stroke:#33424f;stroke-width:1.5}"
        "circle{fill:#fff;stroke:none}text{font:11px sans-serif;text-anchor:middle;fill:#1d2830}"
        ".state{font-size:14px;font-weight:bold}"
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 900 370" role="img" '
        f'aria-label="States of the firmware"><style>{style}</style><defs><marker id="tip" '
        'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" style="fill:#56646f"/></marker></defs>'
        '<rect width="900" height="370" style="fill:#fff;stroke:none"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def edge(x: float, y: float, towards_x: float, towards_y: float) -> tuple[float, float]:
    """Return where the line from a state's centre towards a point leaves its box."""
    dx, dy = towards_x - x, towards_y - y
    scale = min(52 / abs(dx) if dx else 1e9, 22 / abs(dy) if dy else 1e9)
    return x + scale * dx, y + scale * dy


def cell(text: str) -> str:
    """Return a text that fits into a table cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def commands() -> Iterator[str]:
    """Yield the lines of the page of commands."""
    from sil.cli import COMMANDS

    yield "Exit codes: 0 done and passed, 1 an expectation failed or a difference was found, 2 bad input, 3 a"
    yield "participant died or the run could not finish. `opc4 COMMAND --help` has an example of each."
    yield ""
    for name, summary in COMMANDS.items():
        command = importlib.import_module(f"sil.cli.{name}")
        parser = argparse.ArgumentParser(prog=f"opc4 {name}", add_help=False)
        for argument, how in command.ARGUMENTS:
            parser.add_argument(argument, **how)
        yield f"## `opc4 {name}`"
        yield ""
        yield f"{summary[0].upper()}{summary[1:]}."
        yield ""
        yield "| argument | |"
        yield "|---|---|"
        for action in parser._actions:
            yield f"| `{cell(spelled(action))}` | {cell(action.help or '')} |"
        yield ""


def spelled(action: argparse.Action) -> str:
    """Return an argument as one types it."""
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if isinstance(value, tuple):
        value = " ".join(value)
    if not action.option_strings:
        return value
    takes_none = action.nargs == 0
    return ", ".join(action.option_strings) + ("" if takes_none else f" {value}")


PYTHON_API = {
    "Functions": (
        "sil.api:run",
        "sil.api:simulate",
        "sil.api:whatif",
        "sil.api:diagnose",
        "sil.api:replay",
    ),
    "What they return and raise": (
        "sil.simulation.in_memory:Run",
        "sil.simulation.metrics:Shift",
        "sil.simulation.results:Check",
        "sil.campaign.simulate:SimulatedStroke",
        "sil.api:Sweep",
        "sil.inference.campaign.diagnosis:Diagnosis",
        "sil.log_replay.replay:ReplayResult",
        "can_dbc.errors:InputError",
        "can_dbc.errors:RunError",
    ),
    "Firmware": (
        "controller.firmware:Inputs",
        "controller.firmware:Outputs",
        "controller.position:Calibration",
    ),
    "Plant": (
        "plant.parameters:load",
        "plant.parameters:ParameterSet",
        "plant.effects.stroke_conditions:StrokeConditions",
        "plant.systems.stroke:simulate",
        "plant.systems.stroke:Stroke",
        "plant.systems.length_stroke:LengthStroke",
    ),
}
CONDITIONS = "StrokeConditions(kind='N-B', supply_pressure_pa=9e5, commands=((0.02, 'B', 0.98),))"
EXAMPLES = {
    "sil.api.run": 'run("lab_n_b", {"controller.filter": False}).shifts[0].impact_speed_m_s',
    "sil.api.simulate": 'simulate("plan", {"valve.D_rise": 0.013})[0].stroke.position_m',
    "sil.api.whatif": 'whatif("sensor_delay", out="sensor_delay").numbers["impact_speed_m_s"]',
    "sil.api.diagnose": 'diagnose("measured").as_json()["verdict"]',
    "sil.api.replay": 'replay("first/bus.log", {"controller.filter": False}).differs',
    "sil.simulation.in_memory.Run": 'run("lab_n_b").signals["position_m"].max()',
    "sil.simulation.metrics.Shift": 'run("lab_n_b").shifts[0].confirmed_s',
    "sil.simulation.results.Check": '[c.name for c in run("lab_n_b").checks if not c.passed]',
    "sil.campaign.simulate.SimulatedStroke": '[s.arrival_s for s in simulate("plan")]',
    "sil.api.Sweep": 'whatif("piston_mass", out="mass").to_pandas()',
    "sil.inference.campaign.diagnosis.Diagnosis": 'diagnose("measured").headline',
    "sil.log_replay.replay.ReplayResult": 'replay("first/bus.log").comparison.differing_ticks',
    "can_dbc.errors.InputError": """try:
    run("lab_n_b", {"valve.D_fal": 0.02})
except InputError as error:
    print(error)  # --set valve.D_fal: no such value; expected one of valve.D_fall, ...""",
    "can_dbc.errors.RunError": """try:
    run("lab_n_b", {"firmware": "own.py"})
except RunError as error:
    print(error)  # where the firmware failed, and how""",
    "controller.firmware.Inputs": "Inputs(pulses=(), request=ShiftRequest(Gear.BACKWARD)).request.target",
    "controller.firmware.Outputs": "Firmware(FirmwareConfig()).step(0, Inputs()).valves.duty_b",
    "controller.position.Calibration": "Calibration(FirmwareConfig().sensor).position_m(0.0016, 293.15)",
    "plant.parameters.load": 'load("nominal").value("valve.D_fall")',
    "plant.parameters.ParameterSet": 'load().override({"valve.D_fall": 0.02})["valve.D_fall"].unit',
    "plant.effects.stroke_conditions.StrokeConditions": CONDITIONS,
    "plant.systems.stroke.simulate": f"stroke = simulate(load(), {CONDITIONS}, np.linspace(0.0, 0.2, 401))",
    "plant.systems.stroke.Stroke": "stroke.impact.speed_m_s, stroke.pressure_pa('B').max()",
    "plant.systems.length_stroke.LengthStroke": 'LengthStroke(load(), initial="B").pistons_m',
}
"""By path: one expression or statement; tests/docs runs those that need no files."""


def python_api() -> Iterator[str]:
    """Yield the lines of the page of the Python interface: signatures and docstrings."""
    yield "`from sil import run, simulate, whatif, diagnose, replay`: each function does what the command of its name does, and"
    yield "returns typed values and numpy arrays. Nothing is written unless a folder is given."
    for title, names in PYTHON_API.items():
        yield from ("", f"## {title}", "")
        if title == "Firmware":
            yield from ("Settings of the firmware: [keys](keys.md), table `controller`.", "")
        for module, _, name in (item.partition(":") for item in names):
            yield from described(getattr(importlib.import_module(module), name), f"{module}.{name}")


def described(item: Any, path: str) -> Iterator[str]:
    """Yield heading, signature or fields, docstring and example of a function or class."""
    yield from (f"### `{path}`", "")
    if inspect.isfunction(item):
        yield from ("```python", signature(item), "```", "")
    yield from (*docstring(item), "")
    if example := EXAMPLES.get(path):
        yield from ("```python", example, "```", "")
    if not inspect.isfunction(item):
        for name, annotation in inspect.get_annotations(item).items():
            if not name.startswith("_"):
                yield f"- `{name}: {getattr(annotation, '__forward_arg__', annotation)}`"
        for name, member in vars(item).items():
            function = getattr(member, "fget", getattr(member, "__func__", member))
            if not name.startswith("_") and inspect.isfunction(function) and function.__doc__:
                arguments = "" if isinstance(member, property) else signature(function, name="")
                summary = " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())
                yield f"- `{name}{arguments}`: {summary}"
        yield ""


def signature(function: Any, name: str | None = None) -> str:
    """Return a function's signature as it is written, one argument a line if it is long."""
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", str(inspect.signature(function)))
    name = function.__name__ if name is None else name
    if len(text) < 90 or not name:
        return f"{name}{text}"
    arguments, _, result = text.removeprefix("(").rpartition(") ->")
    lines = re.sub(r", (?![^\[]*\])", ",\n    ", arguments)  # commas outside brackets
    return f"{name}(\n    {lines},\n) ->{result}"


def docstring(item: Any) -> Iterator[str]:
    """Yield a docstring as Markdown: numpydoc sections become lists."""
    lines = [
        line
        for line in (inspect.getdoc(item) or "").splitlines()
        if not line.startswith("Checked by")
    ]
    name = ""
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if following and set(following) == {"-"}:
            yield from (f"**{line}**", "")
        elif line and set(line) == {"-"}:
            continue
        elif line.startswith("    "):
            yield f"{name}: {line.strip()}" if name else f"  {line.strip()}"
            name = ""
        elif following.startswith("    "):
            name = f"- `{line}`"
        else:
            yield line


def messages() -> Iterator[str]:
    """Yield the lines of the page of the CAN contract."""
    from can_dbc.contract import DBC_PATH
    from can_dbc.dbc import load_dbc

    found = load_dbc(DBC_PATH)
    yield f"`can_dbc/opc4.dbc`; {found.dbc.attributes['Baudrate'].value} bit/s, 29-bit identifiers."
    yield ""
    for message in found.messages:
        period = f"every {message.cycle_time:g} ms" if message.cycle_time else "without a period"
        safe = ", end-to-end protected" if "E2EDataIdList" in message.dbc.attributes else ""
        yield f"## {message.name}"
        yield ""
        yield f"`0x{message.frame_id:08X}`, {message.length} bytes, from {', '.join(message.senders)}, {period}{safe}."
        yield ""
        if message.comment:
            yield message.comment
            yield ""
        yield "| signal | bits | factor, offset | range | unit | |"
        yield "|---|---|---|---|---|---|"
        for s in message.signals:
            choices = "; ".join(f"{code} {name}" for code, name in (s.choices or {}).items())
            comment = cell(" ".join(part for part in (s.comment, choices) if part))
            yield (
                f"| {s.name} | {s.start}, {s.length}{' signed' if s.is_signed else ''} | "
                f"{s.scale:g}, {s.offset:g} | {s.minimum:g} to {s.maximum:g} | {s.unit or ''} | {comment} |"
            )
        yield ""


if __name__ == "__main__":
    for name, text in generated().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
