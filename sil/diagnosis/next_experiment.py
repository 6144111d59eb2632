"""The stroke that separates the remaining rivals best.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from plant.errors import IntegrationError
from sil.diagnosis.verdict import Judged, Verdict
from sil.fitting.fit import FitResult
from sil.fitting.model import CampaignModel

ENOUGH = 15.0
"""Distance in log evidence at which two rivals count as separated."""


@dataclass(frozen=True)
class NextExperiment:
    """Conditions of the stroke to measure, what it separates, and how well."""

    conditions: dict[str, Any]
    separates: tuple[str, ...]
    expected_distance: float
    why: str


def next_experiment(
    model: CampaignModel, verdict: Verdict[Judged], judged: list[Judged]
) -> NextExperiment | None:
    """Of the kinds of strokes that were measured, the one at which two rivals differ most.

    Each rival keeps its own fitted healthy quantities, and the stroke's own scatter is fitted away,
    so the distance is what a repeat would really add.  None if nothing needs separating.
    """
    if not verdict.rivals:
        return None
    one, two = verdict.rivals[0][:2]
    first = verdict.leader
    others = [i for i in judged if i.ids and i is not first and (two in i.ids or one not in i.ids)]
    if not others:
        return None
    second = others[0]
    distances: dict[int, float] = {}
    for k in range(len(model.strokes)):
        with suppress(IntegrationError):
            distances[k] = _separation(model, first.training, second.training, k)
    if not distances:
        return None
    best = max(distances, key=lambda k: distances[k])
    distance = distances[best]
    conditions = model.strokes[best].conditions
    repeats = max(1, int(np.ceil(ENOUGH / max(distance, 0.05))))
    return NextExperiment(
        {
            "kind": conditions.kind,
            "supply_pressure_pa": conditions.supply_pressure_pa,
            "load": conditions.load,
            "rest_s": conditions.rest_s,
            "charged_before": list(conditions.charged_before),
            "commands": [list(item) for item in conditions.commands],
            "repeats": repeats,
        },
        (first.name, second.name),
        distance,
        f"like {model.strokes[best].entry.file}: the two explanations differ there by {distance:.2g} "
        f"in log evidence a stroke, more than in any other; {repeats} repeats decide",
    )


def _separation(model: CampaignModel, first: FitResult, second: FitResult, k: int) -> float:
    """Half the squared standardised distance of two predictions, the stroke's scatter fitted away."""
    zero = np.zeros(len(model.scatter))
    one = model.linearise(k, first.shared, zero, first.candidates)
    healthy = first.layout.healthy
    setup = model.setup(k, model.amounts(second.shared, zero), second.candidates, second.values)
    offsets = second.shared[len(model.unit) : healthy] - first.shared[len(model.unit) : healthy]
    change = model.predict(k, setup) - one.base + model.offset_columns[k] @ offsets
    b = one.scatter
    inner = b.T @ change
    inverse = np.linalg.inv(b.T @ b + np.eye(b.shape[1]))
    return 0.5 * float(change @ change - inner @ inverse @ inner)
