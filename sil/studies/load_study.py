"""Read studies by name or file, with the scenario that they start from, and check them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec import structs

from can_dbc import typed_toml
from can_dbc.errors import InputError, nearest, unknown_name
from sil.files.quantity import without_units
from sil.firmware.load import absolute
from sil.simulation import load_scenario
from sil.studies.study import ScenarioStudy, Study, StudyFile, check_rows, filled


def shipped() -> dict[str, Path]:
    """Return the studies that come with the package, by name."""
    folder = Path(__file__).parent / "shipped"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_study(
    where: str, effects: Sequence[str] = (), model: str | None = None, firmware: str | None = None
) -> Study:
    """Read a study file or a shipped study, with effects, model and firmware instead of its own.

    Raises InputError with file, location, what is wrong and what was expected.
    """
    path = _path_of(where)
    table = without_units(typed_toml.read_toml(path), str(path), load_scenario.unit_of_path)
    file = read_file(table, str(path))
    groups = {
        group: [each for choice in getattr(file, group) for each in filled(choice, file.each)]
        for group in ("load", "strategy", "variant")
    }
    file = structs.replace(file, **groups)
    if model is not None:
        file = structs.replace(file, model=model)
    files = [str(path.parent / name) for name in file.effects] + list(effects)
    if files:
        from plant.effects.user_file import load_effects

        file = structs.replace(file, effects=[load_effects(name) for name in files])
    load_scenario.parameters_of(file.model, f"{path}: model" if model is None else "--model")
    check_rows(file, str(path))
    _check_baseline(file, str(path))
    file.check(str(path))
    for k, name in enumerate(file.reads):
        if name not in file.columns():
            unknown = unknown_name(name, file.columns())
            raise InputError(f"{path}: reads[{k}]: {name!r} is {unknown}")
    base = _base_of(file, path)
    if firmware is not None:
        if base is None:
            raise InputError(f"{path}: --firmware: the study runs no firmware; expected none")
        base = {**base[0], "firmware": absolute(firmware, Path())}, base[1]
    return Study(file, str(path), base)


def _check_baseline(file: StudyFile, source: str) -> None:
    """Refuse a baseline that no row has. Raises InputError naming key and value."""
    sweeps = () if file.design.is_drawn else file.sweep
    values = {name: [each.name for each in choices] for name, choices in file.groups.items()}
    values |= {sweep.path: list(map(str, sweep.levels())) for sweep in sweeps}
    for key, value in file.baseline.items():
        if key not in values:
            raise InputError(f"{source}: baseline.{key}: {unknown_name(key, values)}")
        if str(value) not in values[key]:
            expected = ", ".join(values[key])
            raise InputError(f"{source}: baseline.{key}: {value!r}; expected one of {expected}")


def read_file(table: dict[str, Any], source: str) -> StudyFile:
    """Return the keys of a study as the record of its kind. Raises InputError for a wrong one."""
    from sil.studies.kinds import StudyKind

    kind = table.get("kind", "runs")
    if kind == "runs" and "stroke" in table:
        if "scenario" in table:
            raise InputError(f"{source}: expected either scenario = or [stroke], exactly one")
        kind = "stroke"
    return typed_toml.convert(table | {"kind": kind}, StudyKind, source)  # type: ignore[arg-type]


def _path_of(where: str) -> Path:
    path = Path(where)
    if path.suffix == ".toml":
        return path
    studies = shipped()
    if where not in studies:
        near = nearest(where, studies, cutoff=0.3) or list(studies)
        name = typed_toml.one_line(where)
        if path.is_file():
            raise InputError(f"{name}: not a study file; expected a name that ends in .toml")
        raise InputError(f"study {name!r}: no such study; expected one of {', '.join(near)}, ...")
    return studies[where]


def _base_of(file: StudyFile, path: Path) -> tuple[dict[str, Any], Path] | None:
    """Read the scenario that a study names: a file in the study's folder, else a shipped one."""
    if not isinstance(file, ScenarioStudy):
        return None
    near = path.parent / file.scenario
    try:
        return load_scenario.read(str(near) if near.is_file() else file.scenario)
    except InputError as error:
        raise InputError(f"{path}: scenario: {error}") from None
