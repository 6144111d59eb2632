"""Rows of a tuning: a strategy on some hardware, its best parameters, what they give under each load."""

from __future__ import annotations

import math

from can_dbc.errors import InputError
from sil.studies.study import LoadedStudy, Row, texts_of
from sil.studies.tuning import OIL_DAMPER, SPACES, Case, information_delay_s, references, tune


def _strategy(settings: object) -> str:
    name = str(settings)
    if name not in SPACES:
        raise InputError(f"controller.strategy: {name!r}; expected one of {', '.join(SPACES)}")
    return name


def parameters(study: LoadedStudy) -> list[str]:
    """Names of all parameters that the study's strategies have."""
    found: dict[str, None] = {}
    for choice in study.study.strategy:
        try:
            name = _strategy(choice.set.get("controller.strategy", "open_loop"))
        except InputError as error:
            raise InputError(f"{study.source}: strategy {choice.name!r}: {error}") from None
        found.update(dict.fromkeys(SPACES[name]))
    return list(found)


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Cost, what the oil damper gives instead (mean and worst), the parameters, and impact speed and time lost under each load."""
    loads = [choice.name for choice in study.study.load]
    return (
        "cost_m_s",
        "default_cost_m_s",
        "worst_impact_m_s",
        "worst_lost_s",
        "damper_m_s",
        "damper_worst_m_s",
        "damper_worst_lost_s",
        "failed",
        "information_delay_s",
        *(f"best.{name}" for name in parameters(study)),
        *(f"impact_m_s {name}" for name in loads),
        *(f"lost_s {name}" for name in loads),
        *(f"damper_m_s {name}" for name in loads),
    )


def run(study: LoadedStudy, row: Row) -> dict[str, float]:
    """Tune and tell; a parameter that the strategy was left its default of is nan."""
    settings = dict(row.settings)
    strategy = _strategy(settings.pop("controller.strategy", "open_loop"))
    table = study.study.tuning
    hardware = texts_of(settings)
    cases = [Case(choice.name, tuple(texts_of(choice.set))) for choice in study.study.load]
    found = tune(
        study.loaded,
        strategy,
        hardware,
        cases,
        budget=table.candidates,
        seed=table.seed,
        free_s=table.free_s,
        late_m_s2=table.late_m_s2,
    )
    best = found[0]
    default = next(each for each in found if not each.parameters)
    reference = references(study.loaded, hardware, cases)
    lost = [a.time_s - b.time_s for a, b in zip(best.outcomes, reference, strict=True)]
    told = {
        "cost_m_s": best.cost_m_s,
        "default_cost_m_s": default.cost_m_s,
        "worst_impact_m_s": _number(max(each.speed_m_s for each in best.outcomes)),
        "worst_lost_s": _number(max(lost)),
        "failed": float(sum(math.isinf(each.time_s) for each in best.outcomes) > 0),
    }
    damped = references(study.loaded, [*hardware, OIL_DAMPER], cases)
    told["damper_m_s"] = _number(sum(each.speed_m_s for each in damped) / len(damped))
    told["damper_worst_m_s"] = _number(max(each.speed_m_s for each in damped))
    told["damper_worst_lost_s"] = _number(
        max(a.time_s - b.time_s for a, b in zip(damped, reference, strict=True))
    )
    told["information_delay_s"] = information_delay_s(study.loaded(hardware))
    told |= {f"best.{name}": best.parameters.get(name, math.nan) for name in parameters(study)}
    for case, outcome, lost_s in zip(cases, best.outcomes, lost, strict=True):
        told[f"impact_m_s {case.name}"] = _number(outcome.speed_m_s)
        told[f"lost_s {case.name}"] = _number(lost_s)
    for case, outcome in zip(cases, damped, strict=True):
        told[f"damper_m_s {case.name}"] = _number(outcome.speed_m_s)
    return told


def _number(value: float) -> float:
    return value if math.isfinite(value) else math.nan
