"""`python -m tests.mutation [MODULE...]`: see the package."""

from __future__ import annotations

import functools
import gc
import importlib
import json
import os
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import FunctionType

import pytest

from tests.mutation.mutants import PACKAGES, ROOT, Mutant, dependants, modules, mutants
from tests.mutation.running import (
    BROKEN,
    KILLED,
    SURVIVED,
    TESTS,
    Reach,
    children_s,
    functions_of,
    in_fork,
    killed,
    limit_examples,
    loaded_anew,
    reach,
    swapped,
    test_files,
)

LISTED = Path(__file__).with_name("survivors.toml")
BUDGET_S = 4.0
"""Tests that together take longer than this are not all run for one mutant."""
MOST = 0.1
"""Share of the mutants that may survive."""

Plan = dict[str, float]
"""Tests with how long each takes, in the order in which they are to run."""


class Runner:
    """A pytest plugin that goes over mutants instead of tests."""

    session: pytest.Session

    def __init__(self, chosen: Sequence[str]) -> None:
        self.chosen = chosen
        self.items: dict[str, pytest.Item] = {}
        self.reaches: list[Reach] = []
        self.ended: dict[Mutant, int] = {}
        self.kills: Counter[str] = Counter()
        """How many mutants of the present module each file and each test has noticed."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self, session: pytest.Session) -> bool:
        """Measure what the tests reach, then run every mutant."""
        self.session = session
        files = test_files()
        self.reaches = [reach(session, file) for file in files]
        self.items = {
            item.nodeid: item for item in session.perform_collect([str(file) for file in files])
        }
        for item in self.items.values():
            limit_examples(item)
        gc.freeze()  # or else each fork would copy what it only counts
        for module, path in modules().items():
            if not self.chosen or module in self.chosen:
                self.mutate(module, path)
        return True

    def pytest_runtestloop(self) -> bool:
        """Run no test but in forks."""
        return True

    def mutate(self, module: str, path: Path) -> None:
        """Run the mutants of a module, and first of all the module as it is, loaded anew."""
        importlib.import_module(module)
        self.kills.clear()
        functions = functions_of(path)
        stale = dependants(module)
        started_s = processor_s()
        source = path.read_text(encoding="utf-8")
        same = Mutant(module, "as it is", "", 1, source.count("\n"), "", "", source)
        if in_fork(functools.partial(self.noticed, same, path, self.planned(same), [], stale), 300)[
            0
        ]:
            raise SystemExit(f"{module}: a test fails without any change")
        known = set().union(*(found.lines.get(module, ()) for found in self.reaches))
        loading = set().union(*(found.loading.get(module, ()) for found in self.reaches))
        for mutant in mutants(module, path):
            first = mutant.first
            while first > 1 and known.isdisjoint(range(first, mutant.last + 1)):
                first -= 1  # a constant within a statement is on no line that runs
            mutant = mutant._replace(first=first)
            plan = self.planned(mutant)
            in_place = functions.get(mutant.function, [])
            if not loading.isdisjoint(range(first, mutant.last + 1)):
                in_place = []
            ended, killer = in_fork(
                functools.partial(self.noticed, mutant, path, plan, in_place, stale),
                5 + int(4 * sum(plan.values())),
            )
            self.kills.update((killer, killer.partition("::")[0]))
            if ended == BROKEN:
                raise SystemExit(f"{mutant.key}: could not be run")
            self.ended[mutant] = ended
            if ended == SURVIVED:
                print(f"  survived: {as_listed(mutant.key)}", file=sys.__stderr__, flush=True)
        took_s = processor_s() - started_s
        print(
            f"{self.figures(module, [module])}   {took_s:5.0f} s", file=sys.__stderr__, flush=True
        )

    def noticed(
        self,
        mutant: Mutant,
        path: Path,
        plan: Plan,
        functions: Sequence[FunctionType],
        stale: set[str],
    ) -> tuple[int, str]:
        """Run the planned tests with a mutant, put into its functions or, without any, loaded anew."""
        if functions and swapped(mutant, path, functions):
            return killed(self.items[test] for test in plan)
        files = by_file(mutant, plan, self.kills)
        return killed(loaded_anew(self.session, mutant, path, stale, files))

    def planned(self, mutant: Mutant) -> Plan:
        """The tests that reach a mutant, within the budget: those that noticed others first, the module's own, quick ones."""
        known: Plan = {}
        for found in self.reaches:
            lines = found.lines.get(mutant.module, {})
            for line in range(mutant.first, mutant.last + 1):
                known.update({test: found.durations[test] for test in lines.get(line, ())})
        plan, spent_s = {}, 0.0
        for test in sorted(
            known, key=lambda test: (-self.kills[test], not own(mutant, test), known[test])
        ):
            if spent_s + known[test] <= BUDGET_S:
                plan[test] = known[test]
                spent_s += known[test]
        return plan

    def figures(self, heading: str, names: Iterable[str]) -> str:
        """How many mutants of some modules survived."""
        ends = [ended for mutant, ended in self.ended.items() if mutant.module in names]
        left = ends.count(SURVIVED)
        return f"{heading:36} {left:4} of {len(ends):5} survived, {100 * left / max(len(ends), 1):4.1f} %"

    def judged(self) -> int:
        """Print the figures and what the list of survivors lacks or has too many; the exit code."""
        ran = {mutant.module for mutant in self.ended}
        for package in PACKAGES:
            if ours := [name for name in ran if name.partition(".")[0] == package]:
                print(self.figures(package, ours))
        listed = {
            (place, was, becomes)
            for reason in tomllib.loads(LISTED.read_text(encoding="utf-8")).get("kept", ())
            for place, was, becomes in reason["mutants"]
            if place.partition(":")[0] in ran
        }
        survived = {mutant.key for mutant, ended in self.ended.items() if ended == SURVIVED}
        for heading, keys in (
            ("survive and are not listed", survived - listed),
            ("are listed and do not survive", listed - survived),
        ):
            if keys:
                print(f"{len(keys)} {heading}:")
                for key in sorted(keys):
                    print(f"  {as_listed(key)}")
        ends = [*self.ended.values()]
        timed_out = len(ends) - ends.count(SURVIVED) - ends.count(KILLED)
        print(
            f"{self.figures('all', ran)} ({timed_out} of the others by taking too long), "
            f"{processor_s() / 60:.0f} min of processor time"
        )
        return int(not ends or bool(survived - listed) or ends.count(SURVIVED) >= MOST * len(ends))


def own(mutant: Mutant, test: str) -> bool:
    """Whether a test, or a file of tests, is one of the mutant's own module."""
    stem = Path(test.partition("::")[0]).stem
    return stem.startswith("test_" + mutant.module.rpartition(".")[2])


def by_file(mutant: Mutant, plan: Plan, kills: Mapping[str, int]) -> dict[str, list[str]]:
    """The planned tests by their files; first those that noticed others, then the module's own."""
    found: dict[str, list[str]] = {}
    for test in plan:
        found.setdefault(test.partition("::")[0], []).append(test)
    order = sorted(found, key=lambda file: (-kills[file], not own(mutant, file)))
    return {file: found[file] for file in order}


def as_listed(key: tuple[str, str, str]) -> str:
    """A mutant as the list of survivors has it."""
    return f"[{', '.join(json.dumps(text, ensure_ascii=False) for text in key)}],"


def processor_s() -> float:
    """Processor time so far, forks included."""
    return time.process_time() + children_s()


def main(chosen: list[str]) -> int:
    """Make the mutants, run them, print what survived."""
    os.chdir(ROOT)
    if unknown := [name for name in chosen if name not in modules()]:
        print(f"{unknown[0]}: no module of {' or '.join(PACKAGES)}", file=sys.stderr)
        return 2
    runner = Runner(chosen)
    pytest.main(
        ["-q", "-s", "-p", "no:cacheprovider", "--continue-on-collection-errors", TESTS[0]],
        plugins=[runner],
    )
    return runner.judged()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
