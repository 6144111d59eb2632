"""What is replayed with which settings: the run's own in the folder of the log, a file's, or the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from can_dbc import typed_toml
from can_dbc.errors import InputError
from can_dbc.user_file import parse_json, read_user_text
from controller.config import FirmwareConfig
from sil.files.output_folder import RESULT
from sil.files.overrides import NO_SETTINGS, Settings, setting_texts
from sil.firmware.load import absolute, is_program
from sil.log_replay.tick_grid import Survey
from sil.simulation import load_scenario, scenario
from sil.simulation.load_scenario import Loaded


@dataclass(frozen=True)
class ReplaySettings:
    """The settings of a replay.

    description: where the settings are from. own_run: the log is that of the run in `loaded`, whose unit
    had the period `recorded_ns`. free_running: that run was in real time, every node by its own clock.
    """

    loaded: Loaded
    description: str
    own_run: bool
    recorded_ns: int
    free_running: bool = False
    assumed: bool = False
    """Nothing says which settings the recorded firmware had: the defaults are tried."""


def find_settings(
    log: str,
    log_head: Survey,
    *,
    firmware: str | None = None,
    settings: Settings = NO_SETTINGS,
    run: str | None = None,
    with_plant: bool = False,
) -> ReplaySettings:
    """Find the settings: result.json in the folder of the log, else the defaults with the log's periods.

    `firmware`: a file with the firmware's settings (a table of them, a [controller] table, a
    scenario or a result.json), or the program of another firmware (FILE.py or FILE.py:CLASS). `run`: scenario or result.json that the log is of. `settings`:
    values by path; those of the plant need `with_plant`.
    Raises InputError.
    """
    path = Path(log).with_name(RESULT)
    result = _read_result(path) if path.is_file() else {}
    own_run = run is not None or bool(result)
    if own_run:
        run_scenario = load_scenario.load(run or str(path))
        source, raw = run_scenario.source, scenario.expanded(run_scenario.scenario)
        description = f"as in {source}"
    else:
        source, raw = log, _defaults(log_head)
        description = f"defaults, {_periods(raw)} from the log"
    recorded_ns = round(raw["controller"]["period_s"] * 1e9)
    if firmware is not None:
        table = firmware_of(firmware)
        if "firmware" in table:
            description = f"of {firmware}, settings {description}"
        else:
            table["controller"] = {"period_s": recorded_ns / 1e9, **table["controller"]}
            raw.pop("sensor" if not own_run else "", None)
            source, description = firmware, f"as in {firmware}"
        raw |= table
    if not with_plant:
        for key in settings:
            if key.split(".")[0] not in ("controller", "firmware"):
                raise InputError(
                    f"--set {typed_toml.one_line(key, 60)}: not of the firmware, which is replayed "
                    "alone; expected controller..., or --plant or --closed-loop"
                )
    if not own_run and firmware is None:
        _refuse_impossible_periods(raw, log)
    loaded = load_scenario.from_table(raw, source, settings=settings)
    if settings:
        description += " with " + ", ".join(setting_texts(settings))
    free_running = run is None and "mode" in result.get("bus", {})
    assumed = not own_run and firmware is None and not settings
    return ReplaySettings(loaded, description, own_run, recorded_ns, free_running, assumed)


def shipped_firmware() -> dict[str, str]:
    """Return the shipped scenarios whose firmware has settings of its own: name and file."""
    files: dict[bytes, tuple[str, str]] = {msgspec.json.encode(FirmwareConfig()): ("", "")}
    for name, path in load_scenario.shipped().items():
        settings = load_scenario.load(str(path)).scenario.controller
        files.setdefault(msgspec.json.encode(settings), (name, str(path)))
    return dict(filter(all, files.values()))


def firmware_of(firmware: str) -> dict[str, Any]:
    """Return a scenario's keys for the program or settings of --firmware. Raises InputError."""
    if is_program(firmware) or Path(firmware).is_dir():
        return {"firmware": absolute(firmware, Path())}
    if firmware.endswith(".json"):
        table = _read_result(firmware).get("scenario", {}).get("controller")
        if table is None:
            raise InputError(
                f"{firmware}: no firmware settings in it; expected a result.json, or a TOML file"
            )
    else:
        table = typed_toml.read_toml(firmware)
        if isinstance(table.get("vehicle"), dict) and isinstance(table.get("controller"), dict):
            return {"controller": table["controller"], "vehicle": table["vehicle"]}
        if "controller" in table:
            table = table["controller"]
        elif "request" in table and "duration_s" in table:  # a scenario with the default firmware
            table = {}
    if not isinstance(table, dict):
        raise InputError(f"{firmware}: controller: not a table; expected the firmware's settings")
    return {"controller": table}


def _read_result(path: str | Path) -> dict[str, Any]:
    """Return the content of a result.json, nothing if there is no scenario in it. Raises InputError."""
    text = read_user_text(path, "a result.json", (64 << 20))
    try:
        result: dict[str, Any] = parse_json(text)
        return result if isinstance(result["scenario"], dict) else {}
    except (ValueError, KeyError, TypeError):
        return {}


def _defaults(log_head: Survey) -> dict[str, Any]:
    raw: dict[str, Any] = {"name": "replay", "duration_s": 1.0, "request": [], "controller": {}}
    period_ns, sensor_ns = log_head.period_ns or 0, log_head.sensor_period_ns or 0
    is_possible = 2_000_000 <= period_ns <= 20_000_000
    raw["controller"]["period_s"] = period_ns / 1e9 if is_possible else 0.01
    if log_head.gear is not None:
        raw["initial_gear"] = log_head.gear.name.lower()
    if 1_000_000 <= sensor_ns <= 40_000_000:
        raw["sensor"] = {"period_s": sensor_ns / 1e9}
    return raw


def _periods(raw: Mapping[str, Any]) -> str:
    text = f"period {1e3 * raw['controller']['period_s']:g} ms"
    if "sensor" in raw:
        text += f" and sensor period {1e3 * raw['sensor']['period_s']:g} ms"
    return text


def _refuse_impossible_periods(raw: dict[str, Any], log: str) -> None:
    """Refuse a log whose periods the firmware cannot have, without naming parameters of ours."""
    try:
        load_scenario.from_table(raw, log)
    except InputError:
        raise InputError(
            f"{log}: the log shows {_periods(raw)}, with which the firmware does not work; "
            "expected a recording in real time, or its settings by --firmware or --run"
        ) from None
