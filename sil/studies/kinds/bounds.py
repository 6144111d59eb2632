"""Rows that are bounds: the softest stop found for a family of loads at an information delay.

A row sets `bound.family`, `bound.delay_s` and if wanted `bound.extra_s`; all other settings change
the model. `sil.studies.bound_search` searches.
"""

from __future__ import annotations

import functools
import math

from can_dbc.errors import InputError
from plant.parameters import load
from sil.studies.bound_search import bound, clairvoyant, shooters_of
from sil.studies.rows import RowResult
from sil.studies.shooting import FAMILIES
from sil.studies.study import BoundsTable, LoadedStudy, Row, Setting


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the worst impact speeds over the family, and the size of the search."""
    return (
        "open_loop_m_s",
        "damper_m_s",
        "clairvoyant_m_s",
        "bound_m_s",
        "stem_switches",
        "simulations",
        "failed",
    )


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Search the bounds of a row. Raises InputError for a family or delay that is missing or wrong."""
    own = {k[6:]: v for k, v in row.settings.items() if k.startswith("bound.")}
    model = {k: v for k, v in row.settings.items() if not k.startswith("bound.")}
    unknown = set(own) - {"family", "delay_s", "extra_s"}
    if unknown:
        raise InputError(f"bound.{min(unknown)}: unknown; expected family, delay_s, extra_s")
    family = FAMILIES.get(str(own.get("family")))
    if family is None:
        raise InputError(f"bound.family: {own.get('family')!r}; expected {', '.join(FAMILIES)}")
    table = study.study.bounds
    delay_s = seconds("delay_s", own.get("delay_s"), -1.0)
    extra_s = seconds("extra_s", own.get("extra_s", table.extra_s), 0.0)
    known_m_s = softest_known(
        study.study.model, tuple(sorted(model.items())), family.name, extra_s, table
    )
    found = bound(
        load(study.study.model).override(model),  # type: ignore[arg-type]
        family,
        delay_s,
        extra_s,
        most_switches=table.switches,
        budget=table.budget,
        stems=table.stems,
        seed=table.seed,
        known_m_s=known_m_s,
    )
    return RowResult(
        {
            "open_loop_m_s": found.open_loop_m_s,
            "damper_m_s": found.damper_m_s,
            "clairvoyant_m_s": found.clairvoyant_m_s,
            "bound_m_s": found.non_anticipating_m_s,
            "stem_switches": float(found.stem.switches),
            "simulations": float(found.runs),
            "failed": 0.0,
        }
    )


def seconds(name: str, value: Setting | None, low: float) -> float:
    """Return a time of the row's settings, from `low` to 1 s. Raises InputError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"bound.{name}: {value!r}; expected a number of seconds")
    if not (math.isfinite(value) and low <= value <= 1.0):
        raise InputError(f"bound.{name}: {value!r}; expected {low:g} to 1 s")
    return float(value)


@functools.cache
def softest_known(
    model: str,
    values: tuple[tuple[str, Setting], ...],
    family: str,
    extra_s: float,
    table: BoundsTable,
) -> tuple[float, ...]:
    """Return bound (a) of each load; it is the same for all delays, so a worker searches it once."""
    parameters = load(model).override(dict(values))  # type: ignore[arg-type]
    return tuple(
        clairvoyant(
            shooter, most_switches=table.switches, budget=table.budget, seed=table.seed
        ).speed_m_s
        for shooter in shooters_of(parameters, FAMILIES[family], extra_s)
    )
