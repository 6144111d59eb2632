"""A mutant in a fork with the tests that reach its lines: what a test reaches is measured once and kept."""

from __future__ import annotations

import functools
import gc
import hashlib
import importlib.abc
import importlib.util
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import pytest
from _pytest.tmpdir import tmppath_result_key

from tests.mutation.mutants import PACKAGES, ROOT, Mutant, modules

EXAMPLES = 25
"""Property tests draw this many examples at most, and shrink none."""

SURVIVED, KILLED, BROKEN = 0, 1, 3


def in_fork(
    task: Callable[[], tuple[int, str]], limit_s: int, loud: bool = False
) -> tuple[int, str]:
    """Run a task in a fork; its answer, or another number when it took too long or too much."""
    heard, telling = os.pipe()
    child = os.fork()
    if child == 0:
        gc.disable()
        if not loud:
            os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
        signal.alarm(30 * limit_s)
        ended = BROKEN
        try:
            ended, words = task()
            os.write(telling, words.encode()[:4000])
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(ended)
    os.close(telling)
    with os.fdopen(heard, "rb") as pipe:
        words = pipe.read().decode()
    status = os.waitpid(child, 0)[1]
    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else -1, words


def children_s() -> float:
    """Processor time of the forks so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def killed(items: Iterable[pytest.Item | str]) -> tuple[int, str]:
    """Run tests until one fails, and tell its name; a name stands for a file that cannot be loaded."""
    for item in items:
        if isinstance(item, str) or fails(item):
            return KILLED, item if isinstance(item, str) else item.nodeid
    return SURVIVED, ""


def fails(item: pytest.Item, loud: bool = False) -> bool:
    """Whether a test fails, without the report that pytest would write about it."""
    item.stash[tmppath_result_key] = {}  # which a report would set, and tmp_path looks for
    try:
        item.ihook.pytest_runtest_setup(item=item)
        item.ihook.pytest_runtest_call(item=item)
        item.ihook.pytest_runtest_teardown(item=item, nextitem=None)
    except BaseException as error:
        if loud:
            print(f"{item.nodeid}: {error!r}", file=sys.__stderr__, flush=True)
        return True
    return False


def limit_examples(item: Any) -> None:
    """Let a property test draw few examples, and stop at the first that fails."""
    from hypothesis import Phase, settings

    own = getattr(item.obj, "_hypothesis_internal_use_settings", None)
    if own is not None:
        function = getattr(item.obj, "__func__", item.obj)
        function._hypothesis_internal_use_settings = settings(
            own,
            max_examples=min(own.max_examples, EXAMPLES),
            phases=(Phase.explicit, Phase.generate),
            deadline=None,
        )


def functions_of(path: Path) -> dict[str, list[FunctionType]]:
    """The functions that a file defines, by qualified name, wherever they are kept."""
    found: dict[str, list[FunctionType]] = defaultdict(list)
    for thing in gc.get_objects():
        if isinstance(thing, FunctionType) and thing.__code__.co_filename == str(path):
            found[thing.__code__.co_qualname].append(thing)
    return found


def swapped(mutant: Mutant, path: Path, functions: Sequence[FunctionType]) -> bool:
    """Give a function its changed code, if that fits where the old one is."""
    waiting = [compile(mutant.code, str(path), "exec", dont_inherit=True)]
    while waiting:
        code = waiting.pop()
        if code.co_qualname == mutant.function:
            break
        waiting += [const for const in code.co_consts if isinstance(const, CodeType)]
    else:
        return False
    if any(code.co_freevars != function.__code__.co_freevars for function in functions):
        return False
    for function in functions:
        function.__code__ = code
    clear_caches()
    return True


def clear_caches() -> None:
    """Let every test reach what is worked out once and kept."""
    for module in [module for name, module in sys.modules.items() if name.startswith(PACKAGES)]:
        for kept in vars(module).values():
            if isinstance(kept, functools._lru_cache_wrapper):
                kept.cache_clear()


def loaded_anew(
    session: pytest.Session, mutant: Mutant, path: Path, stale: set[str], plan: dict[str, list[str]]
) -> Iterator[pytest.Item | str]:
    """The planned tests, by file, with all modules that a mutant reaches read again."""
    forget(stale)
    sys.meta_path.insert(0, Mutated(mutant.module, path, mutant.code))
    for file, tests in plan.items():
        items = {item.nodeid: item for item in session.perform_collect([file])}
        if session.testsfailed:
            yield file
        for test in tests:
            if test in items:
                limit_examples(items[test])
                yield items[test]


def forget(stale: set[str]) -> None:
    """Drop modules, the tests and what they share, so that the next import reads them anew."""
    for name in [*sys.modules]:
        ours = name in stale or name.startswith(("tests.", "sil.")) or name == "sil"
        if ours and not name.startswith(("tests.conftest", "tests.mutation")):
            del sys.modules[name]
            outer, _, inner = name.rpartition(".")
            if hasattr(
                package := sys.modules.get(outer), inner
            ):  # or else `from outer import inner` finds it
                delattr(package, inner)


class Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from other code than its file's."""

    def __init__(self, module: str, path: Path, code: str) -> None:
        self.module, self.path, self.code = module, path, code

    def find_spec(self, name: str, path: object, target: object = None) -> Any:
        if name != self.module:
            return None
        folders = [str(self.path.parent)] if self.path.stem == "__init__" else None
        return importlib.util.spec_from_file_location(
            name, self.path, loader=self, submodule_search_locations=folders
        )

    def create_module(self, spec: object) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self.code, str(self.path), "exec", dont_inherit=True), module.__dict__)


KEPT = ROOT / "mutants"
TESTS = (
    *("tests/unit/can_dbc", "tests/unit/controller", "tests/contracts/test_codec.py"),
    *("tests/contracts/test_e2e.py", "tests/contracts/test_firmware_contract.py"),
)


class Reach(NamedTuple):
    """What the tests of a file reach: tests by module and line; `loading`: lines by module that run before any test."""

    lines: dict[str, dict[int, set[str]]]
    loading: dict[str, set[int]]
    durations: dict[str, float]


def test_files() -> list[Path]:
    """The files of tests, relative to the root."""
    found = []
    for place in TESTS:
        path = ROOT / place
        found += sorted(path.glob("test_*.py")) if path.is_dir() else [path]
    return [path.relative_to(ROOT) for path in found]


def reach(session: pytest.Session, file: Path) -> Reach:
    """What the tests of a file reach, measured in a fork unless it is known already."""
    digest = hashlib.sha256()
    folders = (ROOT / place for place in TESTS[:2])
    shared = [
        path for folder in folders for path in folder.glob("*.py") if "test_" not in path.name
    ]
    for path in (*modules().values(), *sorted(shared), ROOT / file):
        digest.update(path.read_bytes())
    content = digest.hexdigest()
    KEPT.mkdir(exist_ok=True)
    kept = KEPT / f"{'.'.join(file.with_suffix('').parts)}.json"
    known = kept.exists() and json.loads(kept.read_text())["content"] == content
    if not known and in_fork(lambda: measured(session, file, kept, content), 600, True)[0]:
        raise SystemExit(f"{file}: a test fails without any mutant, or cannot be measured")
    found = json.loads(kept.read_text())
    lines = {
        module: {int(line): set(tests) for line, tests in by_line.items()}
        for module, by_line in found["lines"].items()
    }
    loading = {module: set(lines) for module, lines in found["loading"].items()}
    return Reach(lines, loading, found["durations"])


def measured(session: pytest.Session, file: Path, kept: Path, content: str) -> tuple[int, str]:
    """Write down what the tests of a file reach."""
    import coverage

    include = [f"{ROOT / name}/*" for name in PACKAGES]
    meter = coverage.Coverage(data_file=None, config_file=False, include=include)
    meter.start()
    items = [item for item in session.perform_collect([str(file)]) if counts(item)]
    durations = {}
    for item in items:
        limit_examples(item)
        clear_caches()
        meter.switch_context(item.nodeid)
        started = time.process_time()
        if fails(item, loud=True):
            return KILLED, item.nodeid
        durations[item.nodeid] = round(time.process_time() - started, 4)
        meter.switch_context("")
    meter.stop()
    data = meter.get_data()
    lines: dict[str, dict[int, list[str]]] = defaultdict(dict)
    loading: dict[str, list[int]] = defaultdict(list)
    for module, path in modules().items():
        for line, contexts in data.contexts_by_lineno(str(path)).items():
            lines[module][line] = sorted(durations) if "" in contexts else sorted(contexts)
            loading[module] += [line] if "" in contexts else []
    known = {"content": content, "lines": lines, "loading": loading, "durations": durations}
    kept.write_text(json.dumps(known))
    return SURVIVED, ""


def counts(item: pytest.Item) -> bool:
    """Whether a test is one for mutants."""
    return not any(item.get_closest_marker(name) for name in ("slow", "vcan", "browser"))
