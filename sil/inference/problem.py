"""What is compared with what: blocks of measured numbers, and how a hypothesis predicts them.

All blocks (strokes) share tolerances of the unit, offsets of sensors and the parameters of the hypothesis;
each has scatter of its own. Everywhere, shared [shared] and scatter [scatter] are in prior standard
deviations, the hypothesis' own parameters in typical sizes, compared numbers standardised by their noise.
Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sil.inference.candidate import Candidate, precision, value_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shared:
    """Names of the shared parameters: tolerances, offsets, the hypothesis' own, and the prior precision of these."""

    unit: tuple[str, ...]
    offsets: tuple[str, ...]
    effects: tuple[str, ...]
    precision: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """All shared parameters in order."""
        return self.unit + self.offsets + self.effects

    @property
    def healthy(self) -> int:
        """How many of them are healthy tolerances and offsets; they come first."""
        return len(self.unit) + len(self.offsets)

    @property
    def prior(self) -> Floats:
        """Inverse covariance [shared, shared] of the prior of all of them, no unit."""
        out = np.eye(len(self.names))
        out[self.effect_slice, self.effect_slice] = self.precision
        return out

    @property
    def effect_slice(self) -> slice:
        """Where the hypothesis' own parameters are."""
        return slice(self.healthy, self.healthy + len(self.effects))


@dataclass(frozen=True)
class Block:
    """One block, linearised: residual, smooth prediction (base) and its derivatives by shared and scatter.

    weighted: by weight, what the normal equations need of the rest.
    """

    residual: Floats
    shared: Floats
    scatter: Floats
    base: Floats
    weighted: dict[float, tuple[Floats, ...]] = field(default_factory=dict, repr=False)


class ChannelPart(NamedTuple):
    """The part of a block's residual [n] that one channel has, in standard deviations.

    floor: expected sum of squares if nothing is wrong; spread: of its rms, beyond what counting gives.
    """

    name: str
    residual: Floats
    floor: float
    spread: float


class Problem(ABC):
    """Measured blocks and the healthy spread: what any hypothesis is compared with.

    unit, offsets, scatter: names of the shared healthy parameters and of those of one block;
    measured: by block, all compared numbers [n]; has_tangents: its derivatives are no differences of finite steps.

    A front end is a package of `sil/inference/` (a layer in pyproject.toml) with a class derived from this one.
    `diagnose` in campaign/diagnosis.py shows the order: the problem, of records and `Spread.of`; `candidates`
    that they can show; `Search(...).run()`, the verdict; `detectable`; `diagnosis_json` and `headline` of
    report.py. sil/cli/diagnose.py chooses it by the input. One that fits by itself offers its `Explanation`s
    to `decide`, as force/ does; truck/ has a verdict of its own.
    """

    unit: tuple[str, ...]
    offsets: tuple[str, ...]
    scatter: tuple[str, ...]
    measured: list[Floats]
    has_tangents = False

    def layout(self, candidates: Sequence[Candidate]) -> Shared:
        """Layout of the shared parameters under a hypothesis."""
        effects = tuple(
            f"{item.name}.{parameter.name}" for item in candidates for parameter in item.parameters
        )
        return Shared(self.unit, self.offsets, effects, precision(candidates))

    def effect_values(
        self, candidates: Sequence[Candidate], scaled: Floats
    ) -> tuple[dict[str, float], ...]:
        """Return the effect parameters from scaled [parameters], limited to the physical bounds."""
        left = iter(scaled.tolist())
        return tuple(
            {p.name: value_of(p, next(left)) for p in item.parameters} for item in candidates
        )

    @property
    def size(self) -> int:
        """Number of blocks."""
        return len(self.measured)

    @abstractmethod
    def name_of(self, k: int) -> str:
        """Return the name of block k, as a user knows it."""

    @abstractmethod
    def stratum(self, k: int) -> Hashable:
        """Return what blocks that say the same have in common with block k."""

    @abstractmethod
    def offsets_in(self, k: int) -> Collection[str]:
        """Return the names of the offsets that block k depends on."""

    @abstractmethod
    def parts(self, k: int, residual: Floats) -> Iterator[ChannelPart]:
        """Yield the parts of a residual [n] of block k by channel."""

    @abstractmethod
    def residual(
        self, k: int, shared: Floats, scatter: Floats, candidates: Sequence[Candidate]
    ) -> Floats:
        """Return measured - predicted [n] of block k; raises IntegrationError where it cannot be predicted."""

    @abstractmethod
    def changed(
        self,
        k: int,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        values: Sequence[Mapping[str, float]],
    ) -> Floats:
        """Return the smooth prediction [n] of block k, without offsets; raises IntegrationError where there is none."""

    @abstractmethod
    def linearise(
        self,
        k: int,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        central: bool = False,
        own_only: bool = False,
        reuse: Block | None = None,
        frozen: Collection[int] = (),
    ) -> Block:
        """Return block k linearised at shared [shared] and its own scatter.

        own_only: by the hypothesis' own parameters alone, the other derivatives are zero; reuse: a
        block whose derivatives by tolerances and scatter are taken over; frozen: indices of shared
        parameters by which the derivatives are not needed: zero.
        """
