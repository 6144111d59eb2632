"""Scenarios from a TOML file or a result.json: short forms, overrides, parameters of the plant."""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from can_dbc import typed_toml
from can_dbc.errors import InputError, nearest, unknown_name
from can_dbc.user_file import parse_json
from sil.files.overrides import Settings, leaf_paths, set_value
from sil.files.quantity import unit_of, without_units
from sil.firmware.load import absolute
from sil.simulation.scenario import FirmwareTable, Scenario, check_consistent

if TYPE_CHECKING:
    from plant.parameters import ParameterSet


@dataclass(frozen=True)
class Loaded:
    """A scenario with its model parameters, overrides applied."""

    scenario: Scenario
    parameters: ParameterSet
    source: str


def shipped() -> dict[str, Path]:
    """Return the scenarios that come with the package, by name."""
    folder = Path(__file__).parent / "scenarios"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


class Overrides(TypedDict, total=False):
    """What replaces values of a scenario file: model of the plant, values by path, files of effects, seed."""

    model: str | None
    settings: Settings
    effects: Sequence[str]
    seed: int | None


def load(where: str, **given: Unpack[Overrides]) -> Loaded:
    """Load a scenario file, a result.json, or a shipped scenario by name, and apply overrides.

    Raises InputError naming file and key, what is wrong and what was expected.
    """
    table, path = read(where)
    return from_table(table, str(path), folder=path.parent, **given)


def read(where: str) -> tuple[dict[str, Any], Path]:
    """Return a scenario file or shipped scenario as parsed, and its path. Raises InputError."""
    path = _path_of(where)
    if path.suffix != ".json":
        return typed_toml.read_toml(path), path
    try:
        result = parse_json(path.read_text(encoding="utf-8"))
        table = result["scenario"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: file: no scenario in it; expected a result.json") from None
    if not isinstance(table, dict):
        raise InputError(f"{path}: scenario: not a table; expected that of a result.json")
    return table, path


def from_table(
    table: Mapping[str, Any], source: str, *, folder: Path = Path(), **given: Unpack[Overrides]
) -> Loaded:
    """Build a scenario from a parsed `source`, model files in `folder`. Raises InputError as `load`."""
    model, seed = given.get("model"), given.get("seed")
    settings, effects = given.get("settings", {}), given.get("effects", ())
    raw = copy.deepcopy(dict(table))
    scenario = _checked(raw, source)
    if model is not None:
        raw["model_set"] = model
    elif scenario.model_set.endswith(".toml"):
        raw["model_set"] = str(folder / scenario.model_set)
    if scenario.firmware:
        raw["firmware"] = absolute(scenario.firmware, folder)
    if scenario.effects or effects:
        from plant.effects.user_file import load_effects

        files = [str(folder / file) for file in scenario.effects] + list(effects)
        raw["effects"] = list(dict.fromkeys(load_effects(file) for file in files))
    where = f"{source}: model_set" if model is None else "--model"
    parameters = parameters_of(raw.get("model_set", scenario.model_set), where)
    if seed is not None:
        raw["seed"] = seed
        scenario = _checked(raw, "--seed")
    for path, value in settings.items():
        value = value.tolist() if hasattr(value, "tolist") else copy.deepcopy(value)  # numpy
        _apply(raw, path, value, parameters)
        if path == "sensor.period_s" and f"controller.{path}" not in settings:
            _inside(raw, "controller", "sensor").pop("period_s", None)
    if settings:
        scenario = _checked(raw, "--set")
        if scenario.firmware:
            raw["firmware"] = absolute(scenario.firmware, Path())
    scenario = typed_toml.convert(raw, Scenario, source)
    check_consistent(scenario, source)
    return Loaded(scenario, _overridden(parameters, scenario.model, source, settings), source)


def _path_of(where: str) -> Path:
    path = Path(where)
    with contextlib.suppress(OSError, ValueError):  # a name too long, or with a null byte
        if path.is_file():
            return path
    scenarios = shipped()
    if where in scenarios:
        return scenarios[where]
    if "/" in where or where.endswith((".toml", ".json")):
        what = "a folder" if path.is_dir() else "not found"
        raise InputError(f"{typed_toml.one_line(where)}: file: {what}; expected a scenario file")
    raise InputError(f"{typed_toml.one_line(where)}: scenario: {unknown_name(where, scenarios)}")


def _checked(raw: dict[str, Any], source: str) -> Scenario:
    """Rewrite the short forms in place: filter = false, [firmware], [model.valve] D_fall, "7bar"; return the scenario.

    One sensor period is both the sensor's and the firmware's; the gears and ratios of [vehicle] become
    those of plant and controller.
    """
    controller = raw.get("controller")
    if isinstance(controller, dict) and not isinstance(controller.get("filter", {}), dict):
        if not isinstance(controller["filter"], bool):
            shown = typed_toml.one_line(repr(controller["filter"]))
            what = f"{shown} is wrong; expected true or false, or a table"
            raise InputError(f"{source}: controller.filter: {what}")
        controller["filter"] = {"enabled": controller["filter"]}
    if isinstance(firmware := raw.get("firmware"), dict):
        limits = typed_toml.convert(firmware, FirmwareTable, source, key="firmware")
        raw["firmware"] = limits.file
        for name in ("instructions", "stack_bytes"):
            if (limit := getattr(limits, f"max_{name}")) is not None:
                _inside(raw, "expect", "metrics")[f"firmware_{name}"] = {"max": limit}
    if isinstance(model := raw.get("model"), dict):
        raw["model"] = without_units(dict(_flat(model, source, "")), source, unit_of_path)
    raw.update(without_units(raw, source))
    typed_toml.refuse_not_finite(raw, source)
    scenario = typed_toml.convert(raw, Scenario, source)
    if "period_s" in raw.get("sensor", {}):
        _inside(raw, "controller", "sensor").setdefault("period_s", raw["sensor"]["period_s"])
    if vehicle := raw.get("vehicle"):
        ratios = {key: vehicle[key] for key in vehicle if key.startswith("ratio_")}
        gears = {key: vehicle[key] for key in vehicle if key.startswith("gear_")}
        driveline, broadcast = _inside(raw, "driveline"), _inside(raw, "controller", "broadcast")
        driveline.update({"follows_requests": True} | driveline | ratios)
        broadcast.update({"etc2_period_s": 0.1} | broadcast | ratios | gears)
    return scenario


def unit_of_path(path: str) -> str:
    """Return the unit of a value by its path: of a model's parameter, else what its name ends in."""
    return _nominal()[path].unit if path in _nominal() else unit_of(path)


def _inside(raw: dict[str, Any], *keys: str) -> Any:
    """Return the table inside tables that is reached by keys, each made if missing."""
    for key in keys:
        raw = raw.setdefault(key, {})
    return raw


def _flat(table: Mapping[str, Any], source: str, prefix: str) -> Iterable[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            if prefix.count(".") > 3:
                inside = typed_toml.one_line(f"model.{prefix}{key}")
                raise InputError(f"{source}: {inside}: nested too deeply; expected section.key")
            yield from _flat(value, source, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def parameters_of(model_set: str, where: str) -> ParameterSet:
    """Return a parameter set whose effects are known. Raises InputError that begins with `where`."""
    try:
        from plant.parameters import load_actuator

        parameters = _nominal() if model_set == "nominal" else load_actuator(model_set)
        if parameters.effects:
            from plant.effects import check_effects

            check_effects(parameters.effects, parameters.name)
        return parameters
    except InputError as error:
        raise InputError(f"{where}: {typed_toml.one_line(str(error))}") from None


@functools.cache
def _nominal() -> ParameterSet:
    """Return the set that every scenario starts from, which cannot be changed and is read once."""
    from plant.parameters import load_actuator

    return load_actuator("nominal")


def _overridden(
    parameters: ParameterSet,
    changes: Mapping[str, float | list[float]],
    source: str,
    settings: Settings,
) -> ParameterSet:
    try:
        if any(path.startswith("effect.") for path in changes):
            from plant.effects import overridden

            return overridden(parameters, changes)
        return parameters.override(changes)
    except InputError as error:
        is_set = any(f" {path.removeprefix('model.')}: " in str(error) for path in settings)
        raise InputError(f"{'--set' if is_set else f'{source}: model'}: {error}") from None


def _apply(raw: dict[str, Any], path: str, value: Any, parameters: ParameterSet) -> None:
    """Set the value at a path of the raw scenario. Raises InputError for one that does not exist."""
    if path in parameters or path.startswith("effect."):
        raw.setdefault("model", {})[path] = value
        return
    if path == "controller.filter" and isinstance(value, bool):
        path = "controller.filter.enabled"
    strategy_key = path.removeprefix("controller.strategy_parameters.")
    if strategy_key != path and _set_strategy(raw, strategy_key, value):
        return
    if not set_value(raw, Scenario, path, value):
        paths = [*leaf_paths(Scenario, raw), *parameters]
        near = nearest(path, paths, 5, 0.4) or ["valve.D_fall", "controller.period_s"]
        what = f"no such value; expected one of {', '.join(near)}, ..."
        raise InputError(f"--set {typed_toml.one_line(path)}: {what}")


def _set_strategy(raw: dict[str, Any], path: str, value: Any) -> bool:
    """Set a strategy's own setting, nested ones too; the firmware refuses names it does not have."""
    *tables, name = path.split(".")
    try:
        table = _inside(raw, "controller", "strategy_parameters", *tables)
    except AttributeError:  # a value, not a table
        return False
    is_settable = isinstance(table, dict) and "" not in (*tables, name)
    if is_settable:
        table[name] = value
    return is_settable
