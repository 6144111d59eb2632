"""report.html of a run: one self-contained page that needs no network."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import msgspec

from sil.results import Result, finite


def told(value: Any) -> str:
    """Return a value of an expectation as a reader wants it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, dict):
        names = {"min": "at least", "max": "at most"}
        return ", ".join(f"{names.get(k, k)} {told(v)}" for k, v in value.items()) or "any"
    if isinstance(value, list | tuple):
        return ", ".join(told(v) for v in value) or "none"
    return str(value)


def number(value: float | None) -> str:
    """Return a number with three significant digits."""
    return "none" if value is None else f"{value:.3g}"


def milliseconds(value: float | None, digits: int = 1) -> str:
    """Return seconds as milliseconds."""
    return "none" if value is None else f"{1e3 * value:.{digits}f}"


def tiles(metrics: dict[str, Any]) -> list[dict[str, str]]:
    """Return the figures at the top of the page."""
    rows = [
        ("shift time, request to stop", "shift_time_s", 1e3, "ms", 0),
        ("impact speed", "impact_speed_m_s", 1.0, "m/s", 2),
        ("impact energy", "impact_energy_j", 1.0, "J", 1),
        ("position late at 10 %", "position_lag_10_s", 1e3, "ms", 0),
        ("position late at 90 %", "position_lag_90_s", 1e3, "ms", 0),
        ("air used", "air_used_kg", 1e3, "g", 2),
        ("valve switchings", "valve_switchings", 1, "", 0),
    ]
    return [
        {"name": name, "value": f"{metrics[key] * scale:.{digits}f} {unit}".strip()}
        for name, key, scale, unit, digits in rows
        if metrics.get(key) is not None
    ]


def run_page(result: Result, picture: bytes | None, plots: dict[str, str] | None = None) -> str:
    """Return the page of a run; `picture` is a PNG on light paper, `plots` of `run_plots`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters.update(
        told=told,
        number=number,
        ms=milliseconds,
        ms3=lambda value: milliseconds(value, 3),
    )
    plain = msgspec.to_builtins(result)
    details = {
        key: plain[key] for key in ("versions", "balances", "speed", "bus", "scenario", "model")
    }
    return environment.get_template("run.html").render(
        result=plain,
        tiles=tiles(result.metrics),
        plots=plots,
        picture=picture and base64.b64encode(picture).decode(),
        details=json.dumps(finite(details), indent=1, ensure_ascii=False),
    )
