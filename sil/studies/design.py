"""How swept values are combined: the points of a design, in a fixed order."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Value = float | int | bool | str
MAX_ROWS = 5_000_000


class Design(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How swept values are combined.

    one_at_a_time: all at their first value, then each at its others; radial: centres, and round each
    one value after another at another place.
    """

    kind: Literal["grid", "list", "lhs", "sobol", "one_at_a_time", "radial"] = "grid"
    """How swept values are combined: full grid, value by value (list), Latin hypercube, Sobol,
    one at a time from the first values, or radially round drawn points."""
    samples: Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)] = 0
    """Number of samples of a hypercube or Sobol design, of centres of a radial one."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)] = 0
    """Seed of a hypercube or Sobol design."""

    @property
    def is_drawn(self) -> bool:
        """Whether it draws values from ranges."""
        return self.kind in ("lhs", "sobol", "radial")

    def problem(self, sweeps: Sequence[SweptValue]) -> str:
        """Return what is wrong with the design of some sweeps, empty if nothing is."""
        if self.is_drawn and self.samples < 1:
            return "design.samples: expected 1 or more"
        if self.is_drawn and not sweeps:
            return f"a {self.kind} design without [[sweep]]; expected one"
        if self.kind == "list" and len({sweep.size for sweep in sweeps}) > 1:
            return "design list: the sweeps have different lengths"
        return ""


class SweptValue(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One swept value: a list of values, or a range (for designs: its bounds)."""

    path: str
    """Value that is swept, by the path that --set takes."""
    values: list[Value] | None = None
    """Its values; or else a range."""
    low: float | None = None
    """Lower end of the range."""
    high: float | None = None
    """Upper end of the range."""
    steps: Annotated[int, msgspec.Meta(ge=2, le=MAX_ROWS)] | None = None
    """Number of values in the range."""
    scale: Literal["linear", "log", "normal"] = "linear"
    """Equal distances, equal ratios, or (in designs) normally distributed, 95 % within the range."""
    label: str = ""
    """Text for figures; if empty, the path."""
    unit: str = ""
    """Unit for figures."""

    @property
    def title(self) -> str:
        """What figures and tables call it."""
        return self.label or self.path

    @property
    def size(self) -> int:
        """Number of values in a design that draws none."""
        return self.steps or 2 if self.values is None else len(self.values)

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the range."""
        assert self.low is not None and self.high is not None
        return self.low, self.high

    def problem(self, design: Design) -> str:
        """Return what is wrong with the sweep in a design, empty if nothing is."""
        ranged = self.low is not None or self.high is not None
        if (self.values is None) == (not ranged):
            return "expected values, or low and high"
        if self.values is not None:
            if not self.values:
                return "values: empty; expected at least one"
            return f"a {design.kind} design needs low and high" if design.is_drawn else ""
        if self.low is None or self.high is None or not self.low < self.high:
            return "expected low < high"
        if self.scale == "log" and self.low <= 0.0:
            return "a log range needs low > 0"
        if self.scale == "normal" and not design.is_drawn:
            return "a normal range needs a design that draws; expected lhs, sobol or radial"
        return "steps: expected 2 or more" if not design.is_drawn and self.steps is None else ""

    def levels(self) -> list[Value]:
        """Return the values in a design that draws none."""
        if self.values is not None:
            return list(self.values)
        spaced = np.geomspace if self.scale == "log" else np.linspace
        return [float(x) for x in spaced(*self.ends, self.size)]

    def at_share(self, share: float) -> float:
        """Return the value at a share, 0 to 1, of the range."""
        low, high = self.ends
        if self.scale == "log":
            return float(low * (high / low) ** share)
        if self.scale == "normal":
            from scipy.special import ndtri

            return float(0.5 * (low + high) + (high - low) * ndtri(share) / (2.0 * ndtri(0.975)))
        return float(low + (high - low) * share)


def design_size(design: Design, sweeps: Sequence[SweptValue]) -> int:
    """Return the number of points of a design without making them."""
    if design.is_drawn:
        return design.samples * (len(sweeps) + 1 if design.kind == "radial" else 1)
    counts = [sweep.size for sweep in sweeps]
    combined = {"grid": math.prod(counts), "one_at_a_time": sum(counts, 1 - len(counts))}
    return combined.get(design.kind, max(counts, default=1))


def design_points(design: Design, sweeps: Sequence[SweptValue]) -> list[tuple[Value, ...]]:
    """Return all points of a design, in a fixed order, one value for each sweep."""
    if not sweeps:
        return [()]
    if design.is_drawn:
        shares = drawn_shares(design, len(sweeps))
        return [tuple(map(SweptValue.at_share, sweeps, row)) for row in shares]
    columns = [sweep.levels() for sweep in sweeps]
    if design.kind == "grid":
        return list(itertools.product(*columns))
    if design.kind == "list":
        return list(zip(*columns, strict=True))
    base = tuple(column[0] for column in columns)
    single = [(k, value) for k, column in enumerate(columns) for value in column[1:]]
    return [base, *((*base[:k], value, *base[k + 1 :]) for k, value in single)]


def drawn_shares(design: Design, dimension: int) -> NDArray[np.float64]:
    """Return the points [points, dimension] of a design that draws, as shares of the ranges.

    radial: centres, each followed by itself with one value after another replaced, drawn independently.
    """
    from scipy.stats import qmc

    shares: NDArray[np.float64]
    if design.kind == "radial":
        drawn = np.random.default_rng(design.seed).random((design.samples, 2, dimension))
        centres, others = drawn[:, :1], drawn[:, 1:]
        moved = np.where(np.eye(dimension, dtype=np.bool_), others, centres)
        shares = np.concatenate([centres, moved], axis=1).reshape(-1, dimension)
    elif design.kind == "lhs":
        shares = qmc.LatinHypercube(dimension, rng=design.seed).random(design.samples)
    else:
        sampler = qmc.Sobol(dimension, scramble=True, rng=design.seed)
        shares = sampler.random_base2(math.ceil(math.log2(design.samples)))[: design.samples]
    return shares
