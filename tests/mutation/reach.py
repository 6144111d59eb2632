"""Which test reaches which line of the packages, and how long it takes; measured once and kept."""

from __future__ import annotations

import hashlib
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.mutation.mutants import PACKAGES, ROOT, modules
from tests.mutation.running import KILLED, SURVIVED, clear_caches, fails, in_fork, limit_examples

KEPT = ROOT / "mutants"
TESTS = (
    *("tests/unit/can_dbc", "tests/unit/controller", "tests/contracts/test_codec.py"),
    *("tests/contracts/test_e2e.py", "tests/contracts/test_firmware_contract.py"),
)


class Reach(NamedTuple):
    """What the tests of one file reach: by module and line, its tests; all of them where loading does.

    `loading`: by module, the lines that run before any test.
    """

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
