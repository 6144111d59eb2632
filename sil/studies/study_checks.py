"""What the types of a study cannot say: one base, complete sweeps, names, sizes, known metrics.

Checked by: tests/unit/sil/studies/test_whatif.py
"""

from __future__ import annotations

import math

from can_dbc.errors import InputError
from sil.files import typed_toml
from sil.studies.study import MOST_ROWS, Choice, LoadedStudy, Study


def check_study(study: Study, source: str) -> None:
    """Refuse a study that cannot be, before any of its rows is made. Raises InputError."""
    check_shape(study, source)
    check_names(study, source)
    check_size(study, source)


def check_shape(study: Study, source: str) -> None:
    """One base, complete sweeps, unique names."""
    bases = (study.scenario is not None, study.stroke is not None)
    wanted = {"runs": ((True, False), (False, True)), "bounds": ((False, False),)}
    if bases not in wanted.get(study.kind, ((True, False),)):
        expected = {
            "runs": "either scenario = or [stroke], exactly one",
            "bounds": "no scenario and no [stroke], where kind is bounds",
        }.get(study.kind, f"scenario = and no [stroke], where kind is {study.kind}")
        raise InputError(f"{source}: expected {expected}")
    if study.kind == "tuning" and not (study.load and study.strategy):
        raise InputError(f"{source}: a tuning needs [[load]] and [[strategy]]; expected both")
    for index, sweep in enumerate(study.sweep):
        place = f"{source}: sweep[{index}] {sweep.path}"
        ranged = sweep.low is not None or sweep.high is not None
        if (sweep.values is None) == (not ranged):
            raise InputError(f"{place}: expected values, or low and high")
        if sweep.values is not None and not sweep.values:
            raise InputError(f"{place}: values: empty; expected at least one")
        if ranged:
            if sweep.low is None or sweep.high is None or not sweep.low < sweep.high:
                raise InputError(f"{place}: expected low < high")
            if sweep.scale == "log" and sweep.low <= 0.0:
                raise InputError(f"{place}: a log range needs low > 0")
            if study.design.kind in ("grid", "list") and (sweep.steps is None or sweep.steps < 2):
                raise InputError(f"{place}: steps: expected 2 or more")
        if study.design.kind in ("lhs", "sobol") and not ranged:
            raise InputError(f"{place}: a {study.design.kind} design needs low and high")
    if study.design.kind in ("lhs", "sobol") and study.design.samples < 1:
        raise InputError(f"{source}: design.samples: expected 1 or more")
    if study.safety and (study.scenario is None or study.kind != "runs"):
        raise InputError(f"{source}: safety: expected a study of runs with a scenario as base")
    for name in ("load", "strategy", "variant"):
        names = [item.name for item in getattr(study, name)]
        if len(set(names)) != len(names):
            raise InputError(f"{source}: {name}: a name stands twice")


def check_names(study: Study, source: str) -> None:
    """Names that a file and a table can bear, and no value that is set twice over."""
    named = [("name", study.name)]
    for group in ("load", "strategy", "variant"):
        items: list[Choice] = getattr(study, group)
        named += [(f"{group}[{k}].name", item.name) for k, item in enumerate(items)]
    for place, name in named:
        if not name.isprintable() or not name.strip():
            raise InputError(f"{source}: {place}: {name[:60]!r}; expected printable characters")
    if "/" in study.name or "\\" in study.name or study.name.startswith("."):
        raise InputError(f"{source}: name: {study.name!r}; expected a name, not a path")
    paths = [sweep.path for sweep in study.sweep]
    for path in paths:
        if paths.count(path) > 1:
            raise InputError(f"{source}: sweep: {path} is swept twice; expected each once")
    for group in ("load", "strategy", "variant"):
        for item in getattr(study, group):
            for path in item.set:
                if path in paths:
                    raise InputError(
                        f"{source}: {group} {item.name!r}: {path} is swept, too; expected one of them"
                    )


def check_size(study: Study, source: str) -> None:
    """Refuse more rows than `MOST_ROWS` before any of them is made."""
    if study.design.kind in ("lhs", "sobol"):
        if not study.sweep:
            raise InputError(
                f"{source}: a {study.design.kind} design without [[sweep]]; expected one"
            )
        size = study.design.samples
    else:
        counts = [
            sweep.steps or 2 if sweep.values is None else len(sweep.values) for sweep in study.sweep
        ]
        size = math.prod(counts) if study.design.kind == "grid" else max(counts, default=1)
    groups = [study.variant, study.strategy, [] if study.kind == "tuning" else study.load]
    size *= math.prod(len(items) for items in groups if items)
    if size > MOST_ROWS:
        raise InputError(f"{source}: {size} rows; expected at most {MOST_ROWS}")


def check_metrics(loaded: LoadedStudy) -> None:
    """Refuse `reads` that no row tells."""
    from sil.studies.rows import columns

    known = columns(loaded)
    for k, name in enumerate(loaded.study.reads):
        if name not in known:
            told = typed_toml.unknown_name(name, known)
            raise InputError(f"{loaded.source}: reads[{k}]: {name!r} is {told}")
    stroke = loaded.study.stroke
    if stroke is not None:
        valves = ("1", "2") if stroke.kind == "fixed" else ("B", "N", "F")
        for k, (_time_s, valve, _duty) in enumerate(stroke.commands):
            if valve not in valves:
                raise InputError(
                    f"{loaded.source}: stroke.commands[{k}]: valve {valve!r}; "
                    f"expected {', '.join(valves)}"
                )
