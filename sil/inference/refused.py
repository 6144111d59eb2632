"""Values of hypotheses that could not be simulated: how many, of how many, and why the first was not.

A fit goes on without them. What it then says of a hypothesis holds for the other values alone.
Checked by: tests/unit/sil/inference/test_refused.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from plant.errors import IntegrationError
from sil.files.quantity import counted
from sil.inference.candidate import Candidate


@dataclass(frozen=True)
class Tried:
    """Values of a hypothesis: how many were tried and refused; first: why the first was refused.

    lost: fits of it that were given up for that reason.
    """

    ids: tuple[str, ...]
    tried: int = 0
    refused: int = 0
    lost: int = 0
    first: str = ""

    def __add__(self, other: Tried) -> Tried:
        return Tried(
            self.ids,
            self.tried + other.tried,
            self.refused + other.refused,
            self.lost + other.lost,
            self.first or other.first,
        )

    def __str__(self) -> str:
        given_up = f", {self.lost} of its fits given up" if self.lost else ""
        return (
            f"{self.refused} of {counted(self.tried, 'value')} tried cannot be simulated: left out"
            f"{given_up}; the first: {self.first}"
        )


def shown(candidates: Sequence[Candidate], values: Sequence[Mapping[str, float]]) -> str:
    """Return values of a hypothesis in words, empty for a hypothesis without any or a term's nodes."""
    named = [
        f"{name} {value:.4g}"
        for item, parameters in zip(candidates, values, strict=True)
        if not item.is_term
        for name, value in parameters.items()
    ]
    return f"{', '.join(named)} in " if named else ""


class Refusals(dict[str, Tried]):
    """What was tried of every hypothesis, by the name that its fit has."""

    def add(self, candidates: Sequence[Candidate], error: IntegrationError | None) -> None:
        """Count a value of a hypothesis that was simulated, or could not be because of an error."""
        self._add(candidates, refused=int(error is not None), tried=1, first=str(error or ""))

    def lose(self, candidates: Sequence[Candidate], error: IntegrationError) -> None:
        """Count a fit of a hypothesis that was given up because of an error."""
        self._add(candidates, lost=1, first=str(error))

    def _add(self, candidates: Sequence[Candidate], **counts: int | str) -> None:
        name = "+".join(item.name for item in candidates) or "healthy"
        ids = tuple(item.id for item in candidates)
        self.join({name: Tried(ids, **counts)})  # type: ignore[arg-type]

    def join(self, others: dict[str, Tried]) -> None:
        """Add what another process counted."""
        for name, item in others.items():
            self[name] = self[name] + item if name in self else item
