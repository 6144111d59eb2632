"""PATH=VALUE settings of the command line, as values for a parameter set."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable

from can_dbc.errors import InputError


def model_settings(settings: Iterable[str]) -> dict[str, float | list[float]]:
    """Texts PATH=VALUE (VALUE a TOML number or list of numbers) as path -> value.

    Raises InputError for a text without '=', or a value that is no number.
    """
    changes: dict[str, float | list[float]] = {}
    for text in settings:
        path, found, raw = text.partition("=")
        if not found or not path:
            raise InputError(f"--set {text!r}: expected PATH=VALUE")
        try:
            value = tomllib.loads(f"value = {raw}")
        except tomllib.TOMLDecodeError:
            raise InputError(f"--set {path}: {raw!r} is no number") from None
        if set(value) != {"value"}:
            raise InputError(f"--set {path}: {raw!r} is no number")
        changes[path.strip()] = value["value"]
    return changes
