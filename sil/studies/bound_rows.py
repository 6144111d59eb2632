"""Rows of a study of bounds: a family of loads, an information delay, values of the model."""

from __future__ import annotations

import functools
import math

from can_dbc.errors import InputError
from sil.studies.study import BoundsTable, LoadedStudy, Row, Setting

COLUMNS = (
    "open_loop_m_s",
    "damper_m_s",
    "clairvoyant_m_s",
    "bound_m_s",
    "stem_switches",
    "simulations",
    "failed",
)


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Worst impact speeds over the family, and what was searched."""
    return COLUMNS


def run(study: LoadedStudy, row: Row) -> dict[str, float]:
    """The bounds of a row.

    Raises InputError for a family or a delay that is missing or wrong.
    """
    from plant.parameters import load
    from sil.studies.bounds import bound
    from sil.studies.shooting import FAMILIES

    own = {k[6:]: v for k, v in row.settings.items() if k.startswith("bound.")}
    model = {k: v for k, v in row.settings.items() if not k.startswith("bound.")}
    strangers = set(own) - {"family", "delay_s", "extra_s"}
    if strangers:
        raise InputError(f"bound.{min(strangers)}: unknown; expected family, delay_s, extra_s")
    family = FAMILIES.get(str(own.get("family")))
    if family is None:
        raise InputError(f"bound.family: {own.get('family')!r}; expected {', '.join(FAMILIES)}")
    table = study.study.bounds
    numbers = {}
    for name, low, default in (("delay_s", -1.0, None), ("extra_s", 0.0, table.extra_s)):
        value = own.get(name, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"bound.{name}: {value!r}; expected a number of seconds")
        if not (math.isfinite(value) and low <= value <= 1.0):
            raise InputError(f"bound.{name}: {value!r}; expected {low:g} to 1 s")
        numbers[name] = float(value)
    known_m_s = softest_known(
        study.study.model, tuple(sorted(model.items())), family.name, numbers["extra_s"], table
    )
    found = bound(
        load(study.study.model).override(model),  # type: ignore[arg-type]
        family,
        numbers["delay_s"],
        numbers["extra_s"],
        most_switches=table.switches,
        budget=table.budget,
        stems=table.stems,
        seed=table.seed,
        known_m_s=known_m_s,
    )
    return {
        "open_loop_m_s": found.open_loop_m_s,
        "damper_m_s": found.damper_m_s,
        "clairvoyant_m_s": found.clairvoyant_m_s,
        "bound_m_s": found.non_anticipating_m_s,
        "stem_switches": float(found.stem.switches),
        "simulations": float(found.runs),
        "failed": 0.0,
    }


@functools.cache
def softest_known(
    model: str,
    values: tuple[tuple[str, Setting], ...],
    family: str,
    extra_s: float,
    table: BoundsTable,
) -> tuple[float, ...]:
    """(a) of each load: the same for all delays, so that a worker searches it once."""
    from plant.parameters import load
    from sil.studies.bounds import clairvoyant, shooters_of
    from sil.studies.shooting import FAMILIES

    parameters = load(model).override(dict(values))  # type: ignore[arg-type]
    return tuple(
        clairvoyant(
            shooter, most_switches=table.switches, budget=table.budget, seed=table.seed
        ).speed_m_s
        for shooter in shooters_of(parameters, FAMILIES[family], extra_s)
    )
