"""The study file: what is run, which values change, over which loads and strategies."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError

if TYPE_CHECKING:
    from sil.simulation.load_scenario import Loaded


Value = float | int | bool | str
Setting = Value | list[dict[str, Value] | Value]
"""What a choice may set: a value, or a list of values or of tables (requests, faults)."""
LONGEST_S = 60.0
CHUNK = 16
"""Rows of runs that a worker takes at a time; the longer rows of other kinds are taken one by one."""
MOST_ROWS = 5_000_000

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=80)]


class StrokeBase(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The plant alone: one stroke by a list of commands (time s, valve, duty)."""

    kind: Literal["fixed", "N-B", "B-N", "N-F", "F-N"]
    """Rig and stroke."""
    commands: list[
        tuple[
            Annotated[float, msgspec.Meta(ge=0.0, le=LONGEST_S)],
            str,
            Annotated[float, msgspec.Meta(ge=0.0, le=1.0)],
        ]
    ]
    """Valve commands: time in s, valve, duty."""
    until_s: Annotated[float, msgspec.Meta(ge=0.001, le=LONGEST_S)] = 0.3
    """Simulated time."""
    supply_pressure_pa: Annotated[float, msgspec.Meta(ge=1e5, le=2e6)] = 900000.0
    """Supply pressure, absolute."""
    load: Literal["none", "damper", "spring"] = "none"
    """What is coupled to the stay."""
    damper_model: Literal["compressible", "incompressible"] = "compressible"
    """How the oil of the damper is modelled."""
    charged_before: list[str] = []
    """Chambers at supply pressure at the start."""
    mounted: bool = False
    """Mounted on the gearbox."""
    mesh_force_n: Annotated[float, msgspec.Meta(ge=0.0, le=1e5)] = 0.0
    """Peak of the force against meshing."""
    sync_impulse_n_s: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 0.0
    """Impulse that the synchronizer needs."""


class Sweep(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One swept value: a list of values, or a range (for designs: its bounds).

    `scale` "log" spaces a range by equal ratios; "normal" makes its ends the 2.5 and 97.5 % points
    of a normal distribution.
    """

    path: str
    """Value that is swept, by the path that --set takes."""
    values: list[Value] | None = None
    """Its values; or else a range."""
    low: float | None = None
    """Lower end of the range."""
    high: float | None = None
    """Upper end of the range."""
    steps: Annotated[int, msgspec.Meta(ge=2, le=MOST_ROWS)] | None = None
    """Number of values in the range."""
    scale: Literal["linear", "log", "normal"] = "linear"
    """Equal distances, equal ratios, or (in designs) normally distributed, 95 % within the range."""
    label: str = ""
    """Text for figures; if empty, the path."""
    unit: str = ""
    """Unit for figures."""


class Choice(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named set of values: a load case, a strategy, a variant of the hardware."""

    name: Name
    """Name in tables and figures."""
    set: dict[str, Setting] = {}
    """Values that the choice sets, by path."""


class Design(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How swept values are combined.

    one_at_a_time: all at their first value, then each at its others; radial: centres, and round each
    one value after another at another place.
    """

    kind: Literal["grid", "list", "lhs", "sobol", "one_at_a_time", "radial"] = "grid"
    """How swept values are combined: full grid, value by value (list), Latin hypercube, Sobol,
    one at a time from the first values, or radially round drawn points."""
    samples: Annotated[int, msgspec.Meta(ge=0, le=MOST_ROWS)] = 0
    """Number of samples of a hypercube or Sobol design, of centres of a radial one."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)] = 0
    """Seed of a hypercube or Sobol design."""


DRAWN = ("lhs", "sobol", "radial")
"""Designs that draw values from ranges."""
Kind = Literal["runs", "budget", "tuning", "sensitivity"]


class TuningTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Size of the search of a tuning, the same for every strategy; see `sil.studies.kinds.tuning`."""

    candidates: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 16
    """Candidates for each strategy."""
    free_s: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.03
    """Extra shift time that costs nothing."""
    late_m_s2: Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)] = 10.0
    """Cost of further shift time: impact speed per time."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of the first search; the second has the next one."""


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A study; exactly one of `scenario` and `stroke` is the base; a sensitivity study has none."""

    name: Name
    """Name of the study."""
    description: str = ""
    """What the study shows."""
    kind: Kind = "runs"
    """What a row is. "runs": one shift. "budget": the delays of one shift. "tuning": the best
    parameters of a strategy over all loads together. "sensitivity": margins of the headlines of "Why
    feedback fails"."""
    tuning: TuningTable = TuningTable()
    """Size of the search of a study of kind tuning."""
    scenario: str | None = None
    """Scenario that is run: a file or a shipped name."""
    stroke: StrokeBase | None = None
    """Stroke of the plant alone that is simulated instead."""
    effects: list[str] = []
    """Python files of a user's own effects, relative to the study."""
    model: str = "nominal"
    """Parameter set or model file of the plant."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)] | None = None
    """Seed of the scenario."""
    sweep: list[Sweep] = []
    """Values that are swept."""
    design: Design = Design()
    """How they are combined."""
    load: list[Choice] = []
    """Load cases."""
    strategy: list[Choice] = []
    """Strategies that are compared."""
    variant: list[Choice] = []
    """Variants of the hardware that are compared."""
    reads: list[str] = []
    """Metrics that the summary and the figures show first."""
    safety: bool = False
    """Report what the faults of each row did (detection, end state, damage); write fault_table.md."""


def groups_of(study: Study) -> dict[str, list[Choice]]:
    """Return the choices of a study by kind, in column order; a tuning takes all loads together."""
    groups = {"variant": study.variant, "strategy": study.strategy, "load": study.load}
    if study.kind == "tuning":
        del groups["load"]
    return {name: found for name, found in groups.items() if found}


def texts_of(settings: Mapping[str, Setting]) -> list[str]:
    """Return settings as PATH=VALUE."""
    return [f"{path}={toml_value(value)}" for path, value in settings.items()]


@dataclass(frozen=True)
class Row:
    """One run of a study: its number, the names of its choices, the values it sets."""

    number: int
    choices: tuple[str, ...]
    settings: dict[str, Setting]

    @property
    def texts(self) -> list[str]:
        """Return the settings as PATH=VALUE, as the command line takes them."""
        return texts_of(self.settings)

    def split(
        self, known: Mapping[str, Collection[str]]
    ) -> tuple[dict[str, Setting], dict[str, Setting]]:
        """Return the settings of the study's own groups by name, and all others by path.

        known: the names that each group may set. Raises InputError for any other name.
        """
        own: dict[str, Setting] = {}
        others: dict[str, Setting] = {}
        for path, value in self.settings.items():
            group, _, name = path.partition(".")
            if group not in known:
                others[path] = value
            elif name in known[group]:
                own[name] = value
            else:
                raise InputError(f"{path}: unknown; expected one of {', '.join(known[group])}")
        return own, others


@dataclass(frozen=True)
class LoadedStudy:
    """A study with its file and its rows; `base` is its scenario, if it has one."""

    study: Study
    source: str
    base: tuple[dict[str, Any], Path] | None = None

    @cached_property
    def digest(self) -> str:
        """Return the hash of everything that decides the rows."""
        table = self.base[0] if self.base else None
        text = json.dumps([msgspec.to_builtins(self.study), table], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def points(self) -> list[tuple[Value, ...]]:
        """Return the points of the design, one value for each sweep."""
        return design_points(self.study, self.source)

    @property
    def groups(self) -> dict[str, list[Choice]]:
        """Return the choices of this study by kind, in column order."""
        return groups_of(self.study)

    @property
    def size(self) -> int:
        """Return the number of rows."""
        return len(self.points) * math.prod(map(len, self.groups.values()))

    def loaded(self, settings: Sequence[str]) -> Loaded:
        """Return the base scenario with settings PATH=VALUE.

        Raises InputError for settings that it does not accept.
        """
        from sil.simulation.load_scenario import from_table

        assert self.base is not None
        table, path = self.base
        return from_table(
            table,
            str(path),
            model=None if self.study.model == "nominal" else self.study.model,
            settings=settings,
            seed=self.study.seed,
            folder=path.parent,
        )

    @property
    def rows_together(self) -> int:
        """Return how many rows in sequence a worker takes at a time."""
        return CHUNK if self.study.kind == "runs" else 1

    @cached_property
    def longest_sight_s(self) -> float:
        """Return the longest time before a motion of the base scenario reaches the status frames."""
        from sil.simulation.safety import sight_s

        return sight_s(self.loaded([]).scenario)

    def rows(self, begin: int = 0) -> Iterator[Row]:
        """Yield the rows from number `begin` on, in their fixed order."""
        combos = list(itertools.product(*self.groups.values()))
        for number in range(begin, self.size):
            point, combo = divmod(number, len(combos))
            settings: dict[str, Setting] = {}
            for choice in combos[combo]:
                settings |= choice.set
            for sweep, value in zip(self.study.sweep, self.points[point], strict=True):
                settings[sweep.path] = value
            yield Row(number, tuple(choice.name for choice in combos[combo]), settings)


def levels(sweep: Sweep) -> list[Value]:
    """Return the values of one sweep in a grid or list."""
    if sweep.values is not None:
        return list(sweep.values)
    spaced = np.geomspace if sweep.scale == "log" else np.linspace
    return [float(x) for x in spaced(sweep.low or 0.0, sweep.high or 0.0, sweep.steps or 2)]


def design_points(study: Study, source: str) -> list[tuple[Value, ...]]:
    """Return all points of the design, in a fixed order, one value for each sweep.

    Raises InputError for a list design whose sweeps differ in length.
    """
    if not study.sweep:
        return [()]
    design, dimension = study.design, len(study.sweep)
    if design.kind in DRAWN:
        from scipy.stats import qmc

        if design.kind == "radial":
            shares = radial_points(dimension, design)
        elif design.kind == "lhs":
            shares = qmc.LatinHypercube(dimension, rng=design.seed).random(design.samples)
        else:
            sampler = qmc.Sobol(dimension, scramble=True, rng=design.seed)
            shares = sampler.random_base2(math.ceil(math.log2(design.samples)))[: design.samples]
        return [tuple(map(inside, study.sweep, row)) for row in shares]
    columns = [levels(sweep) for sweep in study.sweep]
    if design.kind == "grid":
        return list(itertools.product(*columns))
    if design.kind == "list":
        if len({len(column) for column in columns}) != 1:
            raise InputError(f"{source}: design list: the sweeps have different lengths")
        return list(zip(*columns, strict=True))
    base = tuple(column[0] for column in columns)
    single = [(k, value) for k, column in enumerate(columns) for value in column[1:]]
    return [base, *((*base[:k], value, *base[k + 1 :]) for k, value in single)]


def radial_points(dimension: int, design: Design) -> NDArray[np.float64]:
    """Return centres, each followed by itself with one value after another replaced.

    [samples (dimension + 1), dimension], shares of the ranges; centres and replacements are drawn
    independently: halves of one Sobol sequence are correlated where there are few.
    """
    drawn = np.random.default_rng(design.seed).random((design.samples, 2, dimension))
    centres, others = drawn[:, :1], drawn[:, 1:]
    moved = np.where(np.eye(dimension, dtype=np.bool_), others, centres)
    return np.concatenate([centres, moved], axis=1).reshape(-1, dimension)


def inside(sweep: Sweep, share: float) -> float:
    """Return the value at a share, 0 to 1, of the range of a sweep."""
    low, high = sweep.low or 0.0, sweep.high or 0.0
    if sweep.scale == "log":
        return float(low * (high / low) ** share)
    if sweep.scale == "normal":
        from scipy.special import ndtri

        return float(0.5 * (low + high) + (high - low) * ndtri(share) / (2.0 * ndtri(0.975)))
    return float(low + (high - low) * share)


def toml_value(value: Setting | dict[str, Value]) -> str:
    """Return a value, a table, or a list of either, as TOML text."""
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, dict):
        pairs = (f"{json.dumps(k)} = {toml_value(v)}" for k, v in value.items())
        return "{ " + ", ".join(pairs) + " }"
    return json.dumps(value)
