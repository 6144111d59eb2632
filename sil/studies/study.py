"""A study: its file, its design and its rows; what every kind of study has to say of a row."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, RunError
from sil.files.overrides import Settings
from sil.studies.design import MAX_ROWS, Design, SweptValue, Value, design_points, design_size

if TYPE_CHECKING:
    from sil.report.figure import Figure
    from sil.simulation.load_scenario import Loaded

Setting = Value | list[dict[str, Value] | Value]
"""What a choice may set: a value, or a list of values or of tables (requests, faults)."""
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=80)]
Outcome = Literal["passed", "failed", "not run"]
"""failed: the row ran and did not meet what is expected of it. not run: a participant died or the
equations could not be solved."""


class Choice(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named set of values: a load case, a strategy, a variant of the hardware."""

    name: Name
    """Name in tables and figures."""
    set: dict[str, Setting] = {}
    """Values that the choice sets, by path."""


@dataclass(frozen=True)
class StudyRow:
    """One run of a study: its number, the names of its choices, the values it sets."""

    number: int
    choices: tuple[str, ...]
    settings: Settings


@dataclass(frozen=True)
class RowResult:
    """Figures of one row by column, NaN where it has none; its outcome, and why it did not pass."""

    figures: Mapping[str, float]
    outcome: Outcome = "passed"
    reason: str = ""


@dataclass(frozen=True)
class Table:
    """Columns of a finished study: texts, and numbers [rows] in the unit of their name, NaN for none.

    Texts are the choices, `outcome` and `reason`, and swept values that are no numbers.
    """

    texts: dict[str, list[str]]
    numbers: dict[str, NDArray[np.float64]]
    size: int

    @property
    def outcomes(self) -> Counter[str]:
        """Return how many rows have each outcome."""
        return Counter(self.texts["outcome"])


class StudyFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The keys that every study file has. A module of `sil.studies.kinds` adds those of its kind."""

    rows_together: ClassVar[int] = 1
    """How many rows in sequence a worker takes at a time."""

    name: Name
    """Name of the study."""
    description: str = ""
    """What the study shows."""
    effects: list[str] = []
    """Python files of a user's own effects, relative to the study."""
    model: str = "nominal"
    """Parameter set or model file of the plant."""
    sweep: list[SweptValue] = []
    """Values that are swept."""
    design: Design = Design()
    """How they are combined."""
    load: list[Choice] = []
    """Load cases."""
    strategy: list[Choice] = []
    """Strategies that are compared."""
    variant: list[Choice] = []
    """Variants of the hardware that are compared."""
    each: dict[str, list[Value | list[Value]]] = {}
    """Values of {placeholders}: a choice with some is one for each combination of their values.
    Values of placeholders named together, "a b", are lists of one value for each."""
    reads: list[str] = []
    """Metrics that the summary and the figures show first."""
    baseline: dict[str, Value] = {}
    """The row that others of the same load are compared with: names of a variant, strategy or load, and
    swept values by path; the first ones where left out."""

    def __post_init__(self) -> None:
        for names, rows in self.each.items():
            size = len(names.split())
            if any(len(row if isinstance(row, list) else [row]) != size for row in rows):
                raise InputError(f"each.{names}: expected {size} values for each")

    @property
    def groups(self) -> dict[str, list[Choice]]:
        """The choices that multiply the rows, by kind, in column order."""
        groups = {"variant": self.variant, "strategy": self.strategy, "load": self.load}
        return {name: choices for name, choices in groups.items() if choices}

    def check(self, source: str) -> None:
        """Refuse what no other study of this kind could run. Raises InputError."""

    def columns(self) -> tuple[str, ...]:
        """Return the names of the figures of each row; "failed" is one of them."""
        raise NotImplementedError

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Run one row. Raises InputError for wrong settings, RunError if it cannot finish."""
        raise NotImplementedError

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return the figures of a finished study by file name."""
        raise NotImplementedError

    def without_search(self) -> StudyFile:
        """Return the study that judges what its rows have stored. Raises InputError if none do."""
        raise InputError(f"--rejudge: study {self.name!r} does not search; expected one that does")

    def sentences(self, study: Study, table: Table) -> list[str]:
        """Return what the summary says in place of figures of groups."""
        return []

    def texts(self, study: Study, table: Table) -> dict[str, str]:
        """Return further files of a finished study: names and texts."""
        return {}


class ScenarioStudy(StudyFile, frozen=True, kw_only=True):
    """A study whose rows are runs of a scenario."""

    scenario: str
    """Scenario that is run: a file or a shipped name."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)] | None = None
    """Seed of the scenario."""


@dataclass(frozen=True)
class Study:
    """A study file with the scenario that it starts from, if its kind has one."""

    file: StudyFile
    source: str
    base: tuple[dict[str, Any], Path] | None = None
    folder: Path | None = None  # where its rows may store what they have found

    def input_digests(self) -> dict[str, str]:
        """Return what decides the rows, by name, as `sil.simulation.inputs.input_digests` does."""
        from sil.simulation.inputs import input_digests

        table, scenario = self.base or ({}, Path())
        tables = {"the study": msgspec.to_builtins(self.file), "its scenario": table}
        return input_digests(tables, (Path(self.source).parent, scenario.parent, Path()))

    @cached_property
    def points(self) -> list[tuple[Value, ...]]:
        """The points of the design, one value for each sweep."""
        return design_points(self.file.design, self.file.sweep)

    @property
    def size(self) -> int:
        """The number of rows."""
        return len(self.points) * math.prod(map(len, self.file.groups.values()))

    def loaded(self, settings: Settings) -> Loaded:
        """Return the base scenario with settings. Raises InputError for those it does not accept."""
        from sil.simulation.load_scenario import from_table

        assert self.base is not None and isinstance(self.file, ScenarioStudy)
        table, path = self.base
        model = None if self.file.model == "nominal" else self.file.model
        how: Any = {"model": model, "settings": settings, "seed": self.file.seed}
        return from_table(table, str(path), folder=path.parent, **how)

    def rows(self, begin: int = 0) -> Iterator[StudyRow]:
        """Yield the rows from number `begin` on, in their fixed order."""
        paths = [sweep.path for sweep in self.file.sweep]
        combinations = list(itertools.product(*self.file.groups.values()))
        for number in range(begin, self.size):
            point, combination = divmod(number, len(combinations))
            settings: dict[str, Setting] = {}
            for choice in combinations[combination]:
                settings |= choice.set
            settings |= zip(paths, self.points[point], strict=True)
            names = tuple(choice.name for choice in combinations[combination])
            yield StudyRow(number, names, settings)

    def run(self, row: StudyRow) -> RowResult:
        """Run one row, which may end with a reason. Raises InputError naming a row with wrong settings."""
        try:
            return self.file.run(self, row)
        except InputError as error:
            raise InputError(f"{self.source}: row {row.number}: {error}") from None
        except RunError as error:
            return self.without_figures("not run", " ".join(str(error).split()))

    def without_figures(self, outcome: Outcome, reason: str) -> RowResult:
        """Return the result of a row that has no figures."""
        figures = dict.fromkeys(self.file.columns(), math.nan) | {"failed": 1.0}
        return RowResult(figures, outcome, reason)

    def row_groups(self, table: Table) -> dict[str, NDArray[np.int64]]:
        """Return the row numbers [rows of the group] of each combination of choices, by its label."""
        if not self.file.groups:
            return {"": np.arange(table.size)}
        parts = zip(*(table.texts[name] for name in self.file.groups), strict=True)
        labels = np.array([" / ".join(part) for part in parts])
        return {str(label): np.flatnonzero(labels == label) for label in dict.fromkeys(labels)}


def filled(choice: Choice, each: Mapping[str, list[Value | list[Value]]]) -> Iterator[Choice]:
    """Yield a choice for each combination of values of the placeholders that it has."""
    axes = [
        [
            dict(zip(names.split(), row if isinstance(row, list) else [row], strict=True))
            for row in rows
        ]
        for names, rows in each.items()
        if any(f"{{{name}}}" in str(choice) for name in names.split())
    ]
    for parts in itertools.product(*axes):
        values = {f"{{{name}}}": value for part in parts for name, value in part.items()}
        name, settings = _filled([choice.name, choice.set], values)
        yield Choice(name, settings)


def _filled(item: Any, values: Mapping[str, Value]) -> Any:
    if isinstance(item, dict):
        return {_filled(key, values): _filled(value, values) for key, value in item.items()}
    if isinstance(item, list):
        return [_filled(each, values) for each in item]
    if isinstance(item, str):
        if item in values:
            return values[item]
        for placeholder, value in values.items():
            item = item.replace(placeholder, str(value))
    return item


def check_rows(file: StudyFile, source: str) -> None:
    """Refuse designs, names and numbers of rows that no study can have. Raises InputError."""
    for index, sweep in enumerate(file.sweep):
        if problem := sweep.problem(file.design):
            raise InputError(f"{source}: sweep[{index}] {sweep.path}: {problem}")
    if problem := file.design.problem(file.sweep):
        raise InputError(f"{source}: {problem}")
    paths = [sweep.path for sweep in file.sweep]
    if repeated := [path for path in paths if paths.count(path) > 1]:
        raise InputError(f"{source}: sweep: {repeated[0]} is swept twice; expected each once")
    names = [("name", file.name)]
    for group in ("load", "strategy", "variant"):
        choices: list[Choice] = getattr(file, group)
        names += [(f"{group}[{k}].name", choice.name) for k, choice in enumerate(choices)]
        if len({choice.name for choice in choices}) != len(choices):
            raise InputError(f"{source}: {group}: two have the same name; expected different ones")
        for choice in choices:
            if both := [path for path in choice.set if path in paths]:
                where = f"{source}: {group} {choice.name!r}"
                raise InputError(f"{where}: {both[0]} is swept, too; expected one of them")
    for field, name in names:
        if not name.isprintable() or not name.strip():
            raise InputError(f"{source}: {field}: {name[:60]!r}; expected printable characters")
    if "/" in file.name or "\\" in file.name or file.name.startswith("."):
        raise InputError(f"{source}: name: {file.name!r}; expected a name, not a path")
    size = design_size(file.design, file.sweep) * math.prod(map(len, file.groups.values()))
    if size > MAX_ROWS:
        raise InputError(f"{source}: {size} rows; expected at most {MAX_ROWS}")
