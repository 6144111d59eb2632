"""pytest plugin: scenario files as tests, and a fixture that runs scenarios.

In the project's pytest configuration, `opc4_scenarios = scenarios/*.toml` collects each matching
file as one test (`scenarios/**/*.toml`: subfolders too), which passes when every expectation of its
scenario is met. `--opc4-out DIR` keeps each run's folder (picture, page, log, trace) there, under
the path of the scenario. The fixture `opc4_run` runs a scenario, given
by file, shipped name or table, and returns the run with its checks.
Checked by: tests/unit/sil/test_pytest_plugin.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from sil.simulation.in_memory import Run
    from sil.simulation.load_scenario import Loaded
    from sil.simulation.results import Check

PATTERNS, OUT = "opc4_scenarios", "--opc4-out"
FILES = pytest.StashKey[set[Path]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the configuration value and the option."""
    parser.addini(PATTERNS, "scenario files that are tests, by pattern from the root", "linelist")
    group = parser.getgroup("opc4")
    group.addoption(OUT, metavar="DIR", help="keep the folder of each scenario run in DIR")


def pytest_configure(config: pytest.Config) -> None:
    """Find the files that are tests. Raises UsageError for a pattern that matches none."""
    files: set[Path] = set()
    for pattern in config.getini(PATTERNS):
        try:
            matching = set(config.rootpath.glob(pattern)) - {config.rootpath / "pyproject.toml"}
        except (NotImplementedError, ValueError) as error:
            raise pytest.UsageError(f"{PATTERNS}: {pattern}: {error}") from None
        if not matching:
            what = f"no such file in {config.rootpath}; expected one at least"
            raise pytest.UsageError(f"{PATTERNS}: {pattern}: {what}")
        files |= matching
    config.stash[FILES] = files


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> ScenarioFile | None:
    """Take the files that the configuration names."""
    if file_path not in parent.config.stash[FILES]:
        return None
    scenario_file: ScenarioFile = ScenarioFile.from_parent(parent, path=file_path)
    return scenario_file


class ScenarioFile(pytest.File):
    """A scenario file: one test."""

    def collect(self) -> Iterable[ScenarioItem]:
        """Yield the one test of the file."""
        yield ScenarioItem.from_parent(self, name=self.path.stem)


class Unmet(Exception):
    """Expectations that a run did not meet."""


class ScenarioItem(pytest.Item):
    """One scenario, run and judged."""

    def runtest(self) -> None:
        """Run the scenario. Raises Unmet with the expectations that were not met."""
        from sil.simulation import load_scenario
        from sil.simulation.in_memory import run_in_memory

        loaded = load_scenario.load(str(self.path))
        out = self.config.getoption(OUT)
        if out is None:
            checks = run_in_memory(loaded).checks
        else:
            checks = _recorded(loaded, Path(out, self.nodeid.split("::")[0]).with_suffix(""))
        if failed := [check for check in checks if not check.passed]:
            raise Unmet("\n".join(map(str, failed)))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the expectations not met, or the line of the error; else a traceback."""
        from can_dbc.errors import InputError, RunError

        if isinstance(excinfo.value, Unmet | InputError | RunError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the file of the test."""
        return self.path, None, f"scenario {self.name}"


def _recorded(loaded: Loaded, folder: Path) -> list[Check]:
    from can_dbc.errors import RunError
    from sil.files.output_folder import close_folders, prepare_folder
    from sil.report.run_page import write_report
    from sil.simulation import runner

    why: str | None = "the run did not finish"
    try:
        finished = runner.run(loaded, prepare_folder(folder, loaded.scenario.name, True))
        if not finished.result.complete:
            raise RunError(finished.result.why or why)
        write_report(finished, folder)
        why = None
    finally:
        close_folders(why)
    return list(finished.result.expectations)


@pytest.fixture
def opc4_run() -> Callable[..., Run]:
    """Run a scenario: `opc4_run("lab_n_b", "controller.filter=false")`, or a table of its values."""
    from sil.api import run
    from sil.files.overrides import parse_setting

    return lambda scenario, *settings: run(scenario, dict(map(parse_setting, settings)))
