"""Optional libraries: imported when they are needed, with the install command when missing."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError

ROOT = Path(__file__).resolve().parents[2]


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a library of an extra; `purpose` says what needs it.

    Raises InputError with the command that installs it if it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"{purpose} needs {module}, which is not installed; expected it after: "
            f"{install_command(module, extra)}"
        ) from None


def install_command(module: str, extra: str) -> str:
    """Return the command that installs an extra: from the source folder if this is a clone."""
    python = _relative(sys.executable)
    if (ROOT / "pyproject.toml").is_file():
        return f"{python} -m pip install -e '{_relative(str(ROOT))}[{extra}]'"
    return f"{python} -m pip install {module}"


def _relative(path: str) -> str:
    """Return a path below the current folder relative to it, any other path unchanged."""
    relative = os.path.relpath(path)
    return path if relative.startswith("..") else relative
