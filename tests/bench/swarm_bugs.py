"""Ten bugs and ten mutants of the firmware in C: runs until the swarm finds each.

Where a firmware answers the inputs of a run of the shipped one with the same frames, that run would
be the same: it is not made once more. Seconds are those of as many runs on one core.
"""

from __future__ import annotations

import json
import math
import pickle
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from can_dbc.errors import InputError, RunError
from controller.c_settings import content
from sil.firmware.compiler import compiled
from sil.firmware.contract import pack_step
from sil.firmware.load import SHIPPED_IN_C
from sil.firmware.wasm import FirmwareFailure, Instance, Module
from sil.rules import Violation, violations
from sil.rules.shipped import RULES
from sil.simulation.build import firmware_in_c
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import finished
from sil.simulation.load_scenario import from_table
from sil.simulation.loop import Loop
from sil.swarm.hunt import Attempt, Hunt, attempt, transitions
from sil.swarm.shrink import shrink
from tests.support.firmware_bugs import BUGS, MUTANT_SEED, Bug, mutants, with_bug

RUNS = 2048
SEED = 1


class Reference(NamedTuple):
    """A run of the shipped firmware: what came of it, and what its firmware was given and answered."""

    attempt: Attempt
    settings: bytes
    steps: bytes
    """The steps and their frames, packed."""


class Breaks(Exception):
    """A run broke a rule."""


def reference(table: Mapping[str, Any], shipped: Module) -> Reference | None:
    """The run of a table with the shipped firmware; None if it is no valid scenario or fails."""
    try:
        loaded = from_table(table, "swarm")
        loop = Loop(loaded)
        node = firmware_in_c(loop.participants)
        assert node is not None
        node.steps = []
        loop.finish()
    except (InputError, RunError):
        return None
    record = finished(loop).record
    broken = violations(record, circumstances(loaded.scenario), RULES)
    outcome = Attempt(violations=broken, transitions=transitions(record))
    settings = content(loaded.scenario.controller)
    steps = [pack_step(step) for step in node.steps]
    frames = list(answers(shipped, settings, steps))
    return Reference(outcome, settings, zlib.compress(pickle.dumps((steps, frames)), 1))


def answers(module: Module, settings: bytes, steps: Sequence[bytes]) -> Iterator[Any]:
    """The frames of each step."""
    instance = Instance(module, settings)
    for step in steps:
        instance.step(step)
        yield instance.frames()


def is_equal(run: Reference, module: Module) -> bool:
    """Whether a firmware answers the inputs of a run as the shipped one did."""
    steps, frames = pickle.loads(zlib.decompress(run.steps))
    try:
        given = answers(module, run.settings, steps)
        return all(one == other for one, other in zip(given, frames, strict=True))
    except FirmwareFailure:
        return False


class Trials:
    """The runs of one firmware, counted; those that equal the shipped one's are taken from it."""

    def __init__(self, module: Path, shipped: Path, runs: dict[str, Reference | None]) -> None:
        self.module = Module(module.read_bytes(), str(module))
        self.shipped = shipped
        self.shipped_module = Module(shipped.read_bytes(), str(shipped))
        self.runs = runs
        self.count = self.different = 0
        self.failing: tuple[dict[str, Any], str] | None = None

    def __call__(self, work: Callable[[Any], Attempt], tables: Sequence[Any]) -> Iterator[Attempt]:
        """Yield what comes of each table. Raises Breaks at the first that breaks a rule."""
        for table in tables:
            key = json.dumps(table | {"firmware": ""})
            if key not in self.runs:
                self.runs[key] = reference(
                    table | {"firmware": str(self.shipped)}, self.shipped_module
                )
            run = self.runs[key]
            self.count += 1
            if run is not None and is_equal(run, self.module):
                yield run.attempt
                continue
            self.different += 1
            outcome = work(table)
            ours = {each.rule for each in run.attempt.violations} if run else set()
            for violation in outcome.violations:
                if violation.rule not in ours:
                    self.failing = table, violation.rule
                    raise Breaks
            yield outcome


def line(
    name: str, bug: Bug, folder: Path, shipped: Path, runs: dict[str, Any], runs_per_s: float
) -> str:
    """The row of one bug."""
    module = folder / f"{abs(hash(name))}.wasm"
    module.write_bytes(compiled(with_bug(bug, folder / module.stem)))
    base = {"name": "swarm", "duration_s": 1.0, "request": [], "firmware": str(module)}
    trials = Trials(module, shipped, runs)
    try:
        list(Hunt(base, SEED, RULES).run(trials, RUNS, math.inf))
    except Breaks:
        assert trials.failing is not None
        table, rule = trials.failing
        seconds = trials.count / runs_per_s
        cells = (f"{trials.count}", f"{seconds:.0f}", rule, size(smallest(table, rule)))
    else:
        cells = ("not found", "", "", f"{trials.different} runs differ")
    return " | ".join((name, *cells))


def smallest(table: dict[str, Any], rule: str) -> dict[str, Any]:
    """The shrunk table."""

    def broken(candidate: Any) -> Violation | None:
        violations = attempt(candidate, RULES).violations
        return next((each for each in violations if each.rule == rule), None)

    return shrink(table, broken)


def size(table: dict[str, Any]) -> str:
    """Length of a scenario, its faults and requests."""
    faults = sum(len(rows) for name, rows in table.items() if name.endswith("fault"))
    return f"{table['duration_s']:.2f} s, {faults} faults, {len(table['request'])} requests"


def rate(shipped: Path) -> float:
    """Runs per second and core of blind drawing."""
    hunt = Hunt(
        {"name": "swarm", "duration_s": 1.0, "request": [], "firmware": str(shipped)}, 2, RULES
    )
    tables = [hunt.table(0, number) for number in range(64)]
    attempt(tables[0], RULES)
    begin = time.process_time()
    for table in tables:
        attempt(table, RULES)
    return len(tables) / (time.process_time() - begin)


def measure() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shipped = folder / "shipped.wasm"
        shipped.write_bytes(compiled(SHIPPED_IN_C))
        runs_per_s = rate(shipped)
        yield f"{runs_per_s:.1f} runs per second and core; budget {RUNS} runs, seed {SEED}; mutants of seed {MUTANT_SEED}"
        yield "bug | runs | seconds | rule | shrunk scenario"
        runs: dict[str, Reference | None] = {}
        for bug_name, bug in {**BUGS, **mutants()}.items():
            yield line(bug_name, bug, folder, shipped, runs, runs_per_s)
