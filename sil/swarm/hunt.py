"""Generations of drawn scenarios.

Scenario n of generation g depends on the seed, g and n: not on the number of workers, nor on the wall
clock. A generation is one line of swarm.jsonl, from which an interrupted swarm goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.messages import ControllerStatus, ShiftState
from sil.recording.run_record import RunRecord
from sil.rules import Rule, Violation, violations
from sil.rules.reports import sent
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import run_in_memory
from sil.simulation.inputs import input_digests
from sil.simulation.judgement import invariants
from sil.simulation.load_scenario import from_table
from sil.swarm.draw import Table, new_table
from sil.swarm.shrink import shrink


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """What came of a scenario; refused: why it is no valid one; transitions: counts of changes of state."""

    refused: str = ""
    violations: list[Violation] = []
    transitions: dict[str, int] = {}


def attempt(table: Mapping[str, Any], rules: Sequence[Rule]) -> Attempt:
    """Run a scenario table and hold it to the rules and to the `invariants`."""
    try:
        loaded = from_table(table, "swarm")
        run = run_in_memory(loaded)
    except InputError as error:
        return Attempt(refused=str(error))
    except RunError as error:
        return Attempt(violations=[Violation("runs_to_the_end", 0.0, str(error))])
    broken = violations(run.record, circumstances(loaded.scenario), rules)
    end_s, checks = loaded.scenario.duration_s, invariants(loaded.scenario, run.balances, run.bus)
    broken += [Violation(c.name.replace(" ", "_"), end_s, str(c)) for c in checks if not c.passed]
    return Attempt(violations=broken, transitions=transitions(run.record))


def transitions(record: RunRecord) -> dict[str, int]:
    """Return how often the controller reported each change of state, by "FROM -> TO"."""
    states = [ShiftState.INIT, *(status.state for _, status in sent(record, ControllerStatus))]
    return Counter(f"{a.name} -> {b.name}" for a, b in pairwise(states) if a is not b)


SWARM_FILE = "swarm.jsonl"
Runner = Callable[[Callable[[Table], Attempt], Sequence[Table]], Iterator[Attempt]]


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A way to break a rule: the shrunk scenario, and what happens in it."""

    rule: str
    text: str
    time_s: float
    table: dict[str, Any]
    drawn: str
    """Generation and number of the scenario that was shrunk."""

    @property
    def cause(self) -> tuple[str, ...]:
        """The rule with the kinds of fault that are needed to break it: reported once."""
        faults = ((name, rows) for name, rows in self.table.items() if name.endswith("fault"))
        return (
            self.rule,
            *sorted(f"{name}.{row['kind']}" for name, rows in faults for row in rows),
        )


class Generation(msgspec.Struct, frozen=True, kw_only=True):
    """What a generation brought."""

    number: int
    runs: int
    refused: int
    wall_s: float
    transitions: dict[str, int]
    """How often each change of state was taken."""
    shortest: dict[str, int]
    """The number of the simplest scenario that takes each."""
    failures: list[Failure]
    broken: dict[str, int]
    """Runs that broke each rule."""


class Hunt:
    """A swarm around a base scenario."""

    def __init__(
        self, base: Mapping[str, Any], seed: int, rules: Sequence[Rule], *, size: int = 256
    ) -> None:
        self._base = dict(base)
        self._seed = seed
        self._rules = tuple(rules)
        self._size = size
        self.generations: list[Generation] = []
        self._causes: set[tuple[str, ...]] = set()

    @cached_property
    def digest(self) -> str:
        """The hash of what the draws depend on: another swarm's generations are not continued."""
        sources = [getattr(rule.first, "__code__", None) for rule in self._rules]
        files = [source.co_filename for source in sources if source]
        names = [rule.name for rule in self._rules]
        inputs = input_digests({"base": self._base, "rules": [names, files]}, (Path(),))
        content = json.dumps([self._seed, self._size, inputs])
        return hashlib.sha256(content.encode()).hexdigest()

    def table(self, generation: int, number: int) -> Table:
        """Return a scenario table of a generation."""
        return new_table(random.Random(f"{self._seed} {generation} {number}"), self._base)

    def add(self, generation: Generation) -> None:
        """Take what a finished generation brought."""
        self._causes.update(failure.cause for failure in generation.failures)
        self.generations.append(generation)

    def run(self, runner: Runner, most_runs: float, until_s: float) -> Iterator[Generation]:
        """Run generations until a number of runs, or a time of `time.monotonic`, is over."""
        for number in count(len(self.generations)):
            runs = sum(generation.runs for generation in self.generations)
            if runs >= most_runs or time.monotonic() >= until_s:
                return
            self.add(self._generation(runner, number))
            yield self.generations[-1]

    def _generation(self, runner: Runner, number: int) -> Generation:
        begun = time.perf_counter()
        tables = [self.table(number, index) for index in range(self._size)]
        shortest: dict[str, int] = {}
        transitions: Counter[str] = Counter()
        broken: Counter[str] = Counter()
        first: dict[str, int] = {}
        attempts = list(runner(partial(attempt, rules=self._rules), tables))
        for index, result in enumerate(attempts):
            transitions.update(result.transitions)
            rules = [violation.rule for violation in result.violations]
            broken.update(rules)
            for best, names in ((shortest, result.transitions), (first, rules)):
                for name in names:
                    best[name] = min(best.get(name, index), index, key=lambda k: size_of(tables[k]))
        shrunk = [self._shrunk(rule, tables[k], f"{number}.{k}") for rule, k in first.items()]
        return Generation(
            number=number,
            runs=len(tables),
            refused=sum(bool(result.refused) for result in attempts),
            wall_s=round(time.perf_counter() - begun, 3),
            transitions=dict(transitions),
            shortest=shortest,
            failures=[failure for failure in shrunk if failure.cause not in self._causes],
            broken=dict(broken),
        )

    def _shrunk(self, rule: str, table: Table, drawn: str) -> Failure:
        def broken(candidate: Mapping[str, Any]) -> Violation | None:
            violations = attempt(candidate, self._rules).violations
            return next((each for each in violations if each.rule == rule), None)

        smallest = shrink(table, broken)
        last = broken(smallest)
        assert last is not None
        return Failure(rule=rule, text=last.text, time_s=last.time_s, table=smallest, drawn=drawn)


def size_of(table: Table) -> tuple[int, float]:
    """Return a measure of how simple a scenario is: lines and settings, then duration in s."""
    rows = sum(len(value) for value in table.values() if isinstance(value, list))
    return rows + len(table.get("controller", ())), table["duration_s"]


def stored_generations(folder: Path, digest: str) -> Iterable[Generation]:
    """Return the generations of an interrupted swarm, without a torn line. Raises InputError for another one."""
    path = folder / SWARM_FILE
    try:
        content = path.read_bytes()
    except OSError:
        what = f"{folder}: --resume: no {SWARM_FILE}; expected a swarm's folder"
        raise InputError(what) from None
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)
    try:
        first, *lines = content[:whole].splitlines()
        stored = msgspec.json.decode(first, type=dict[str, str]).get("sha256")
        generations = [msgspec.json.decode(line, type=Generation) for line in lines]
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise InputError(f"{path}: not the generations of a swarm; expected --force") from None
    if stored != digest:
        other = "another target, seed, set of rules or version"
        raise InputError(f"{path}: a swarm of {other}; expected the same, or --force")
    return generations
