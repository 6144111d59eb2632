"""Read studies by name or file, with the scenario that they start from, and check them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec import structs

from can_dbc import typed_toml
from can_dbc.errors import InputError, nearest, unknown_name
from sil.simulation import load_scenario
from sil.studies.assumptions import LEAST
from sil.studies.rows import columns
from sil.studies.study import DRAWN, MOST_ROWS, LoadedStudy, Study, Sweep, groups_of

SHIPPED = Path(__file__).parent / "shipped"
BASES = {
    "runs": ({(True, False), (False, True)}, "either scenario = or [stroke], exactly one"),
    **dict.fromkeys(("budget", "tuning"), ({(True, False)}, "scenario = and no [stroke]")),
    "sensitivity": ({(False, False)}, "no scenario and no [stroke]"),
}
"""For each kind, which of (scenario, stroke) may be given, and the same in words."""


def shipped() -> dict[str, Path]:
    """Return the studies that come with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def load_study(where: str, effects: Sequence[str] = (), model: str | None = None) -> LoadedStudy:
    """Read a study file, or a shipped study by name.

    effects: files of a user's own effects; model: parameter set or model file instead of the study's.

    Raises InputError with file, location, what is wrong and what was expected.
    """
    path = Path(where)
    if not where.endswith(".toml"):
        known = shipped()
        if where not in known:
            near = nearest(where, known, cutoff=0.3) or list(known)
            name = typed_toml.one_line(where)
            if path.is_file():
                raise InputError(f"{name}: not a study file; expected a name that ends in .toml")
            raise InputError(
                f"study {name!r}: no such study; expected one of {', '.join(near)}, ..."
            )
        path = known[where]
    study = typed_toml.convert(typed_toml.read_toml(path), Study, str(path))
    if model is not None:
        study = structs.replace(study, model=model)
    files = [str(path.parent / file) for file in study.effects] + list(effects)
    if files:
        from plant.effects.user_file import load_effects

        study = structs.replace(study, effects=[load_effects(file) for file in files])
    load_scenario.parameters_of(study.model, f"{path}: model" if model is None else "--model")
    for check in (check_shape, check_names, check_conditions, check_size):
        check(study, str(path))
    loaded = LoadedStudy(study, str(path), base_of(study, path))
    check_metrics(loaded)
    return loaded


def base_of(study: Study, path: Path) -> tuple[dict[str, Any], Path] | None:
    """Read the scenario that a study names: a file in the study's folder, else a shipped one.

    Raises InputError for a scenario that cannot be read.
    """
    if study.scenario is None:
        return None
    near = path.parent / study.scenario
    try:
        table, found = load_scenario.read(str(near) if near.is_file() else study.scenario)
    except InputError as error:
        raise InputError(f"{path}: scenario: {error}") from None
    return table, found


def check_shape(study: Study, source: str) -> None:
    """Refuse a study without exactly one base, or with an incomplete sweep. Raises InputError."""
    allowed, expected = BASES[study.kind]
    if (study.scenario is not None, study.stroke is not None) not in allowed:
        raise InputError(f"{source}: expected {expected}, where kind is {study.kind}")
    if study.kind == "tuning" and not (study.load and study.strategy):
        raise InputError(f"{source}: a tuning needs [[load]] and [[strategy]]; expected both")
    for index, sweep in enumerate(study.sweep):
        if wrong := wrong_sweep(sweep, study.design.kind):
            raise InputError(f"{source}: sweep[{index}] {sweep.path}: {wrong}")
    if study.design.kind in DRAWN and study.design.samples < 1:
        raise InputError(f"{source}: design.samples: expected 1 or more")
    if study.safety and (study.scenario is None or study.kind != "runs"):
        raise InputError(f"{source}: safety: expected a study of runs with a scenario as base")


def wrong_sweep(sweep: Sweep, design: str) -> str:
    """Return what is wrong with a sweep in a design, empty if nothing is."""
    drawn = design in DRAWN
    ranged = sweep.low is not None or sweep.high is not None
    if (sweep.values is None) == (not ranged):
        return "expected values, or low and high"
    if sweep.values is not None:
        if not sweep.values:
            return "values: empty; expected at least one"
        return f"a {design} design needs low and high" if drawn else ""
    if sweep.low is None or sweep.high is None or not sweep.low < sweep.high:
        return "expected low < high"
    if sweep.scale == "log" and sweep.low <= 0.0:
        return "a log range needs low > 0"
    if sweep.scale == "normal" and not drawn:
        return "a normal range needs a design that draws; expected lhs, sobol or radial"
    return "steps: expected 2 or more" if not drawn and sweep.steps is None else ""


def check_names(study: Study, source: str) -> None:
    """Refuse names that no file or table can hold, and values set twice. Raises InputError."""
    paths = [sweep.path for sweep in study.sweep]
    if twice := [path for path in paths if paths.count(path) > 1]:
        raise InputError(f"{source}: sweep: {twice[0]} is swept twice; expected each once")
    named = [("name", study.name)]
    for group in ("load", "strategy", "variant"):
        items = getattr(study, group)
        named += [(f"{group}[{k}].name", item.name) for k, item in enumerate(items)]
        if len({item.name for item in items}) != len(items):
            raise InputError(f"{source}: {group}: two have the same name; expected different ones")
        for item in items:
            if both := [path for path in item.set if path in paths]:
                where = f"{source}: {group} {item.name!r}"
                raise InputError(f"{where}: {both[0]} is swept, too; expected one of them")
    for field, name in named:
        if not name.isprintable() or not name.strip():
            raise InputError(f"{source}: {field}: {name[:60]!r}; expected printable characters")
    if "/" in study.name or "\\" in study.name or study.name.startswith("."):
        raise InputError(f"{source}: name: {study.name!r}; expected a name, not a path")


def check_conditions(study: Study, source: str) -> None:
    """Refuse conditions of a sensitivity study below their least value. Raises InputError."""
    if study.kind != "sensitivity":
        return
    given: list[tuple[str, object]] = [
        (sweep.path, value)
        for sweep in study.sweep
        for value in sweep.values or (sweep.low, sweep.high)
    ]
    given += [
        pair for items in groups_of(study).values() for item in items for pair in item.set.items()
    ]
    for path, value in given:
        least = LEAST.get(path, -math.inf)
        if isinstance(value, (int, float)) and value < least:
            raise InputError(f"{source}: {path}: {value:g}; expected {least:g} or more")


def check_size(study: Study, source: str) -> None:
    """Refuse more rows than `MOST_ROWS` before any of them is made. Raises InputError."""
    kind, sweeps = study.design.kind, study.sweep
    if kind in DRAWN:
        if not sweeps:
            raise InputError(f"{source}: a {kind} design without [[sweep]]; expected one")
        size = study.design.samples * (len(sweeps) + 1 if kind == "radial" else 1)
    else:
        counts = [s.steps or 2 if s.values is None else len(s.values) for s in sweeps]
        combined = {"grid": math.prod(counts), "one_at_a_time": sum(counts, 1 - len(counts))}
        size = combined.get(kind, max(counts, default=1))
    size *= math.prod(map(len, groups_of(study).values()))
    if size > MOST_ROWS:
        raise InputError(f"{source}: {size} rows; expected at most {MOST_ROWS}")


def check_metrics(loaded: LoadedStudy) -> None:
    """Refuse `reads` that no row has, and valves that the stroke has not. Raises InputError."""
    known = columns(loaded)
    for k, name in enumerate(loaded.study.reads):
        if name not in known:
            unknown = unknown_name(name, known)
            raise InputError(f"{loaded.source}: reads[{k}]: {name!r} is {unknown}")
    stroke = loaded.study.stroke
    valves = "12" if stroke is not None and stroke.kind == "fixed" else "BNF"
    for k, (_time_s, valve, _duty) in enumerate(stroke.commands if stroke is not None else ()):
        if len(valve) != 1 or valve not in valves:
            where = f"{loaded.source}: stroke.commands[{k}]"
            raise InputError(f"{where}: valve {valve!r}; expected {', '.join(valves)}")
