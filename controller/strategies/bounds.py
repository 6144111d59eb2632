"""Bounds of a strategy's settings."""

from __future__ import annotations

from typing import Any

from msgspec import Meta


def bounded(low: float, high: float, unit: str) -> Any:
    """Return the annotation that keeps a setting from `low` to `high` in its unit."""
    return Meta(ge=low, le=high, description=unit)
