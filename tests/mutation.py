"""Mutation testing of controller/ and can_dbc/: mutmut makes the mutants, forks of one session run them.

`python -m tests.mutation [MODULE...]`, e.g. `can_dbc.e2e`, prints the mutants that no test notices; all
modules have some thousand of them, and take a while. mutmut's own loop starts pytest for each mutant; here the
tests are collected once, and each mutant runs, in a fork, those that reach its function, quickest first.
What runs once while modules are loaded (the codecs being built from the contract) has run before the fork, so
mutants there are shown as survivors although a new process would notice them.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "mutants"
EXAMPLES = 25
"""Property tests draw this many examples at most."""

SURVIVED, KILLED, TIMED_OUT = 0, 1, 2
CPU_LIMIT_S = 60


def main(modules: list[str]) -> int:
    """Make the mutants, run them, print what survived; 1 when a tenth or more did."""
    # A pattern that fits no mutant: mutmut makes them all and notes which test reaches which.
    made = subprocess.run(
        [sys.executable, "-m", "mutmut", "run", "none-of-them"], cwd=ROOT, capture_output=True, text=True
    )
    if not (WORK / "mutmut-stats.json").exists():
        print(made.stdout[-2000:], made.stderr[-2000:], file=sys.stderr)
        return 2
    os.chdir(WORK)
    os.environ["MUTANT_UNDER_TEST"] = ""
    sys.path[:0] = [str(WORK)]
    import tomllib

    import pytest

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mutmut"]
    runner = Runner(modules)
    pytest.main(
        [
            *("--rootdir=.", "-q", "--tb=no", "-p", "no:cacheprovider"),
            *settings["pytest_add_cli_args"],
            *settings["pytest_add_cli_args_test_selection"],
        ],
        plugins=[runner],
    )
    return runner.told()


class Runner:
    """A pytest plugin whose loop goes over mutants instead of tests."""

    def __init__(self, modules: list[str]) -> None:
        self.modules = modules
        self.ended: dict[str, int] = {}

    def pytest_runtestloop(self, session: Any) -> bool:
        """Run each mutant in a fork."""
        stats = json.loads(Path("mutmut-stats.json").read_text(encoding="utf-8"))
        items = {item.nodeid: item for item in session.items}
        for item in items.values():
            limit_examples(item)
        reach, duration = stats["tests_by_mangled_function_name"], stats["duration_by_test"]
        for meta in sorted(Path().glob("*/**/*.py.meta")):
            for mutant in json.loads(meta.read_text(encoding="utf-8"))["exit_code_by_key"]:
                if self.modules and not mutant.startswith(tuple(self.modules)):
                    continue
                tests = reach.get(mutant.rpartition("__mutmut_")[0], [])
                known = sorted((t for t in tests if t in items), key=lambda t: duration.get(t, 0.0))
                self.ended[mutant] = in_fork(mutant, [items[test] for test in known])
                if self.ended[mutant] == SURVIVED:
                    print(f"\nsurvived: {mutant} ({len(known)} tests)", file=sys.__stderr__, flush=True)
        return True

    def told(self) -> int:
        """Print the figures by module."""
        by_module: dict[str, list[int]] = defaultdict(list)
        for mutant, ended in self.ended.items():
            by_module[mutant.partition(".x")[0]].append(ended)
        for module, ends in sorted(by_module.items()):
            print(f"{module:36} {ends.count(SURVIVED):4} of {len(ends):4} survived")
        survived, of = list(self.ended.values()).count(SURVIVED), len(self.ended)
        print(f"{survived} of {of} survived, {100.0 * survived / max(of, 1):.1f} %")
        return int(of == 0 or survived >= 0.1 * of)


def in_fork(mutant: str, items: list[Any]) -> int:
    """Run tests until one fails; how it ended. A mutant that no test reaches has survived."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S))
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
        signal.alarm(20 * CPU_LIMIT_S)
        os.environ["MUTANT_UNDER_TEST"] = mutant
        os._exit(run_until_failure(items))
    status = os.waitpid(child, 0)[1]
    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else TIMED_OUT


def run_until_failure(items: list[Any]) -> int:
    """Run tests in this order; KILLED at the first that fails."""
    from _pytest.runner import runtestprotocol

    try:
        for item, following in zip(items, [*items[1:], None], strict=True):
            reports = runtestprotocol(item, log=False, nextitem=following)
            if any(report.failed for report in reports):
                return KILLED
    except BaseException:
        return KILLED
    return SURVIVED


def limit_examples(item: Any) -> None:
    """Let a property test draw few examples."""
    from hypothesis import settings

    own = getattr(item.obj, "_hypothesis_internal_use_settings", None)
    if own is not None and own.max_examples > EXAMPLES:
        function = getattr(item.obj, "__func__", item.obj)
        function._hypothesis_internal_use_settings = settings(own, max_examples=EXAMPLES, deadline=None)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
