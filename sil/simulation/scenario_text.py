"""A scenario as the text of a scenario file: what differs from the defaults, and nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from sil.files.overrides import toml_value
from sil.simulation.scenario import Scenario, expanded


def scenario_toml(scenario: Scenario) -> str:
    """Return the text of a file that loads as this scenario, without its expectations, files as it names them."""
    defaults = expanded(Scenario(name="-", duration_s=1.0, request=[]))
    table = _different(expanded(scenario), defaults)
    table.pop("expect", None)
    for key in ("name", "duration_s", "request"):
        table[key] = expanded(scenario)[key]
    return "\n".join(_lines(table, "")) + "\n"


def _different(table: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    differences: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict) and isinstance(defaults.get(key), dict):
            if inner := _different(value, defaults[key]):
                differences[key] = inner
        elif value is not None and (key not in defaults or value != defaults[key]):
            differences[key] = _without_none(value)
    return differences


def _without_none(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_none(item) for item in value]
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return value


def _lines(table: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """Yield the lines of a table: its values, then its tables."""
    inner: list[tuple[str, Any]] = []
    for key, value in table.items():
        name = key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)
        tables = value if isinstance(value, list) else [value]
        if tables and all(isinstance(item, dict) for item in tables):
            inner.append((prefix + name, value))
        else:
            yield f"{name} = {toml_value(value)}"
    for name, value in inner:
        for item in value if isinstance(value, list) else [value]:
            yield ""
            yield f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
            yield from _lines(item, f"{name}.")
