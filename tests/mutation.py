"""Mutation testing of controller/ and can_dbc/: mutmut's operators, our tests, one fork for each mutant.

`python -m tests.mutation [MODULE...]`, e.g. `can_dbc.e2e` (nothing: all of both packages), prints the figures
by module and what is wrong with `tests/mutation_survivors.toml`, which has to list every mutant that no test
notices, with the reason; 1 when one is missing there, or when a tenth survive.

All that mutmut can change is changed, what runs once at import and decorated functions included (mutmut's own
runner leaves both out). The tests are loaded once; each mutant is a fork of that process, in which its function
gets the changed code and everything kept in caches is forgotten. Where lines run while modules or tests are
loaded, the fork loads all of them anew. Then those tests run that reach the changed lines, the module's own
first and quick ones before slow ones, until one fails. Which test reaches which line is measured with coverage
and kept in `mutants/` while sources and tests stay the same.
"""

from __future__ import annotations

import ast
import functools
import gc
import hashlib
import importlib
import importlib.abc
import importlib.util
import json
import os
import resource
import signal
import sys
import time
import tomllib
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import pytest
from _pytest.tmpdir import tmppath_result_key

ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "mutants"
LISTED = ROOT / "tests" / "mutation_survivors.toml"
PACKAGES = ("can_dbc", "controller")
TESTS = (
    *("tests/unit/can_dbc", "tests/unit/controller", "tests/contracts/test_codec.py"),
    *("tests/contracts/test_e2e.py", "tests/contracts/test_wire_dbc.py"),
    "tests/contracts/test_firmware_contract.py",
)
LEFT_OUT = ("test_import_is_quick",)
"""Tests of durations, which a busy machine would fail."""
EXAMPLES = 25
"""Property tests draw this many examples at most, and shrink none."""
BUDGET_S = 4.0
"""Tests that together take longer than this are not all run for one mutant."""
MOST = 0.1
"""Share of the mutants that may survive."""

SURVIVED, KILLED, BROKEN = 0, 1, 3

Plan = dict[str, float]
"""Tests with how long each takes, in the order in which they are to run."""


class Mutant(NamedTuple):
    """One change: its place, the lines before and after, and the whole module with it.

    `function` is the outermost one around it, empty for what stands outside of functions.
    """

    module: str
    place: str
    function: str
    first: int
    last: int
    was: str
    becomes: str
    code: str

    @property
    def key(self) -> tuple[str, str, str]:
        return f"{self.module}: {self.place}", self.was, self.becomes


class Reach(NamedTuple):
    """What the tests of one file reach: by module and line, its tests; all of them where loading does.

    `loading`: by module, the lines that run before any test.
    """

    lines: dict[str, dict[int, set[str]]]
    loading: dict[str, set[int]]
    durations: dict[str, float]


def modules() -> dict[str, Path]:
    """Every module of both packages with its file."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def mutants(module: str, path: Path) -> Iterator[Mutant]:
    """All mutants of a module, in the order of its lines."""
    import libcst as cst
    from libcst.metadata import MetadataWrapper, PositionProvider
    from mutmut.mutation.file_mutation import MutationVisitor, deep_replace
    from mutmut.mutation.mutators import mutation_operators
    from mutmut.mutation.pragma_handling import IgnoredCode

    class Visitor(MutationVisitor):
        def __init__(self) -> None:
            super().__init__(mutation_operators, IgnoredCode(set(), set(), set()))
            self.spans: list[tuple[int, int]] = []

        def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
            decorated = isinstance(node, cst.FunctionDef)  # which mutmut's trampolines cannot do
            return not decorated and super()._skip_node_and_children(node)

        def _create_mutations(self, node: cst.CSTNode) -> None:
            super()._create_mutations(node)
            at = self.get_metadata(PositionProvider, node, None)
            span = (at.start.line, at.end.line) if at else self.spans[-1]
            self.spans += [span] * (len(self.mutations) - len(self.spans))

    source = path.read_text(encoding="utf-8")
    wrapper = MetadataWrapper(cst.parse_module(source))
    visitor = Visitor()
    tree = wrapper.visit(visitor)
    parts = [tree.code_for_node(statement) for statement in tree.body]
    header = "".join(tree.code_for_node(line) for line in tree.header)
    footer = "".join(tree.code_for_node(line) for line in tree.footer)
    assert header + "".join(parts) + footer == source, path
    starts = [header.count("\n")]
    for part in parts:
        starts.append(starts[-1] + part.count("\n"))
    places, functions = {}, {}
    for name, lines, outermost in _functions(source):
        places.update(dict.fromkeys(lines, name))
        if outermost:
            functions.update(dict.fromkeys(lines, name))
    old = source.splitlines()
    for mutation, (first, last) in zip(visitor.mutations, visitor.spans, strict=True):
        number = next(i for i, start in enumerate(starts[1:]) if first <= start)
        changed = deep_replace(tree.body[number], mutation.original_node, mutation.mutated_node)
        middle = [*parts[:number], tree.code_for_node(changed), *parts[number + 1 :]]
        code = header + "".join(middle) + footer
        new = code.splitlines()
        if new == old:
            continue
        same = next(i for i, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1])
        tail = 0
        while tail < min(len(old), len(new)) - same and old[-1 - tail] == new[-1 - tail]:
            tail += 1
        was, becomes = old[same : len(old) - tail], new[same : len(new) - tail]
        yield Mutant(
            module,
            places.get(first, "module"),
            functions.get(first, ""),
            first,
            last,
            "\n".join(line.strip() for line in was),
            "\n".join(line.strip() for line in becomes),
            code,
        )


def _functions(source: str) -> Iterator[tuple[str, range, bool]]:
    """Functions and classes with their lines, outer ones first, and whether it is an outermost function."""
    waiting: list[tuple[str, ast.AST, bool]] = [("", ast.parse(source), False)]
    while waiting:
        outer, node, inside = waiting.pop(0)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{outer}.{child.name}".lstrip(".")
                is_function = isinstance(child, ast.FunctionDef)
                lines = range(child.lineno, (child.end_lineno or 0) + 1)
                yield name, lines, is_function and not inside
                waiting.append((name, child, inside or is_function))


def dependants(module: str) -> set[str]:
    """Modules of both packages that import a module, directly or not, itself included."""
    imports: dict[str, set[str]] = {}
    for name, path in modules().items():
        imports[name] = found = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    found = {module}
    while more := {name for name, used in imports.items() if used & found} - found:
        found |= more
    return found


class Runner:
    """A pytest plugin that goes over mutants instead of tests."""

    def __init__(self, chosen: Sequence[str]) -> None:
        self.chosen = chosen
        self.items: dict[str, pytest.Item] = {}
        self.reaches: dict[str, Reach] = {}
        self.ended: dict[Mutant, int] = {}
        self.timed_out = 0
        self.kills: Counter[str] = Counter()
        """How many mutants of the present module each file and each test has noticed."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self, session: pytest.Session) -> bool:
        """Measure what the tests reach, then run every mutant."""
        self.reaches = {str(file): reach(session, file) for file in test_files()}
        self.items = {item.nodeid: item for item in session.perform_collect(list(self.reaches))}
        for item in self.items.values():
            limit_examples(item)
        gc.freeze()  # or else each fork would copy what it only counts
        for module, path in modules().items():
            if not self.chosen or module in self.chosen:
                self.mutate(session, module, path)
        return True

    def pytest_runtestloop(self) -> bool:
        """Run no test but in forks."""
        return True

    def mutate(self, session: pytest.Session, module: str, path: Path) -> None:
        """Run the mutants of a module, and first of all the module as it is, loaded anew."""
        importlib.import_module(module)
        self.kills.clear()
        found = functions_of(path)
        stale = dependants(module)
        loading = set().union(*(reach.loading.get(module, ()) for reach in self.reaches.values()))
        started = time.process_time() + children_s()
        source = path.read_text(encoding="utf-8")
        same = Mutant(module, "as it is", "", 1, source.count("\n"), "", "", source)
        plan = by_file(module, planned(same, self.reaches, self.kills), self.kills)
        if in_fork(lambda: killed(loaded_anew(session, same, path, stale, plan)), 300)[0]:
            raise SystemExit(f"{module}: a test fails without any change")
        known = set().union(*(reach.lines.get(module, ()) for reach in self.reaches.values()))
        for mutant in mutants(module, path):
            first = mutant.first
            while first > 1 and known.isdisjoint(range(first, mutant.last + 1)):
                first -= 1  # a constant within a statement is on no line that runs
            mutant = mutant._replace(first=first)
            plan = planned(mutant, self.reaches, self.kills)
            limit_s = 5 + int(4 * sum(plan.values()))
            ends = found.get(mutant.function, [])
            anew = not ends or not loading.isdisjoint(range(mutant.first, mutant.last + 1))

            def task(mutant: Mutant = mutant, plan: Any = plan, ends: Any = ends, anew: bool = anew) -> Any:
                if not anew and swapped(mutant, path, ends):
                    return killed(self.items[test] for test in plan)
                files = by_file(mutant.module, plan, self.kills)
                return killed(loaded_anew(session, mutant, path, stale, files))

            ended, killer = in_fork(task, limit_s)
            self.kills.update((killer, killer.partition("::")[0]))
            if ended == BROKEN:
                raise SystemExit(f"{mutant.key}: could not be run")
            self.timed_out += ended not in (SURVIVED, KILLED)
            self.ended[mutant] = ended
            if ended == SURVIVED:
                told = ", ".join(json.dumps(text, ensure_ascii=False) for text in mutant.key)
                print(f"  survived: [{told}],", file=sys.__stderr__, flush=True)
        took = time.process_time() + children_s() - started
        print(f"{self.line(module)}   {took:5.0f} s", file=sys.__stderr__, flush=True)

    def line(self, *names: str) -> str:
        """The figures of modules that begin with a name."""
        ends = [e for m, e in self.ended.items() if m.module in names or not names]
        left = ends.count(SURVIVED)
        return f"{' '.join(names):36} {left:4} of {len(ends):5} survived, {100 * left / max(len(ends), 1):4.1f} %"


def planned(mutant: Mutant, reaches: dict[str, Reach], kills: Mapping[str, int]) -> Plan:
    """The tests that reach a mutant, within the budget; first those that noticed others, then quick ones."""
    known: dict[str, float] = {}
    for reach in reaches.values():
        lines = reach.lines.get(mutant.module, {})
        for line in range(mutant.first, mutant.last + 1):
            known.update({test: reach.durations[test] for test in lines.get(line, ())})
    plan, spent_s = {}, 0.0
    for test, taken_s in sorted(known.items(), key=lambda entry: (-kills[entry[0]], entry[1])):
        if spent_s + taken_s <= BUDGET_S:
            plan[test] = taken_s
            spent_s += taken_s
    return plan


def by_file(module: str, plan: Plan, kills: Mapping[str, int]) -> dict[str, list[str]]:
    """The same tests by their files; first those that noticed others, then the module's own."""
    found: dict[str, list[str]] = {}
    for test in plan:
        found.setdefault(test.partition("::")[0], []).append(test)
    own = "test_" + module.rpartition(".")[2]
    order = sorted(found, key=lambda file: (-kills[file], not Path(file).stem.startswith(own)))
    return {file: found[file] for file in order}


def killed(items: Iterable[pytest.Item | str]) -> tuple[int, str]:
    """Run tests until one fails, and tell its name; a name stands for a file that cannot be loaded."""
    for item in items:
        if isinstance(item, str) or fails(item):
            return KILLED, item if isinstance(item, str) else item.nodeid
    return SURVIVED, ""


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


def functions_of(path: Path) -> dict[str, list[FunctionType]]:
    """The functions that a file defines, by qualified name, wherever they are kept."""
    found: dict[str, list[FunctionType]] = defaultdict(list)
    for thing in gc.get_objects():
        if isinstance(thing, FunctionType) and thing.__code__.co_filename == str(path):
            found[thing.__code__.co_qualname].append(thing)
    return found


def loaded_anew(
    session: pytest.Session,
    mutant: Mutant,
    path: Path,
    stale: set[str],
    plan: dict[str, list[str]],
) -> Iterator[pytest.Item | str]:
    """The planned tests, with all modules that a mutant reaches read again."""
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


def forget(stale: set[str]) -> None:
    """Drop modules, the tests and what they share, so that the next import reads them anew."""
    for name in [*sys.modules]:
        ours = name in stale or name.startswith(("tests.", "sil.")) or name == "sil"
        if ours and name not in ("tests.conftest", "tests.mutation"):
            del sys.modules[name]
            outer, _, inner = name.rpartition(".")
            if hasattr(package := sys.modules.get(outer), inner):  # or else `from outer import inner` finds it
                delattr(package, inner)


def test_files() -> list[Path]:
    """The files of tests, relative to the root."""
    found = []
    for place in TESTS:
        path = ROOT / place
        found += sorted(path.glob("test_*.py")) if path.is_dir() else [path]
    return [path.relative_to(ROOT) for path in found]


def reach(session: pytest.Session, file: Path) -> Reach:
    """What the tests of a file reach, measured in a fork unless it is known already."""
    content = hashlib.sha256()
    folders = (ROOT / place for place in TESTS[:2])
    shared = [path for folder in folders for path in folder.glob("*.py") if "test_" not in path.name]
    for path in (*modules().values(), *sorted(shared), ROOT / file):
        content.update(path.read_bytes())
    KEPT.mkdir(exist_ok=True)
    kept = KEPT / f"{'.'.join(file.with_suffix('').parts)}.json"
    known = kept.exists() and json.loads(kept.read_text())["content"] == content.hexdigest()
    if not known and in_fork(lambda: measured(session, file, kept, content.hexdigest()), 600, True)[0]:
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

    meter = coverage.Coverage(data_file=None, config_file=False, include=[f"{ROOT / name}/*" for name in PACKAGES])
    meter.start()
    items = [item for item in session.perform_collect([str(file)]) if chosen(item)]
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


def chosen(item: pytest.Item) -> bool:
    """Whether a test is one for mutants."""
    slow = any(item.get_closest_marker(name) for name in ("slow", "vcan", "browser"))
    return not slow and getattr(item, "originalname", item.name) not in LEFT_OUT


def clear_caches() -> None:
    """Let every test reach what is worked out once and kept."""
    for module in [module for name, module in sys.modules.items() if name.startswith(PACKAGES)]:
        for kept in vars(module).values():
            if isinstance(kept, functools._lru_cache_wrapper):
                kept.cache_clear()
    if codec := sys.modules.get("can_dbc.codec"):
        codec._encoders.clear()
        codec._decoders.clear()


def judged(runner: Runner) -> int:
    """Print the figures and what the list of survivors lacks or has too many."""
    ran = {mutant.module for mutant in runner.ended}
    names = modules()
    for package in PACKAGES:
        ours = [name for name in names if name in ran and name.split(".")[0] == package]
        if ours:
            ends = [e for m, e in runner.ended.items() if m.module in ours]
            left = ends.count(SURVIVED)
            print(f"{package}: {len(ends)} mutants, {len(ends) - left} killed, {left} survived, "
                  f"{100 * left / len(ends):.1f} %")  # fmt: skip
    listed: dict[tuple[str, str, str], str] = {}
    for reason in tomllib.loads(LISTED.read_text(encoding="utf-8")).get("kept", ()):
        for place, was, becomes in reason["mutants"]:
            if place.partition(":")[0] in ran:
                listed[place, was, becomes] = reason["why"]
    survived = {mutant.key for mutant, ended in runner.ended.items() if ended == SURVIVED}
    for heading, keys in (
        ("survive and are not listed", survived - listed.keys()),
        ("are listed and do not survive", listed.keys() - survived),
    ):
        if keys:
            print(f"{len(keys)} {heading}:")
            for key in sorted(keys):
                print(f"  [{', '.join(json.dumps(text, ensure_ascii=False) for text in key)}],")
    print(runner.line().strip(), f"({runner.timed_out} of the others by taking too long)")
    ends = list(runner.ended.values())
    unlisted = survived - listed.keys()
    return int(not ends or bool(unlisted) or ends.count(SURVIVED) >= MOST * len(ends))


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
    return judged(runner)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
