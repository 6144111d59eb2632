"""A user's own firmware in place of ours: a class in a Python file.

The class is made with the scenario's firmware settings and has `step(now_ns, inputs) -> outputs`,
as `controller.firmware.Firmware` has; frames, end-to-end protection and timing stay those of the
controller node. The file is the user's program: it is run as it is.
Checked by: tests/unit/sil/nodes/test_own_firmware.py
"""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError

if TYPE_CHECKING:
    from controller.config import FirmwareConfig
    from controller.node import Steps

DEFAULT_CLASS = "Firmware"


def own_firmware(where: str, config: FirmwareConfig) -> Steps:
    """Make the firmware that `where`, FILE.py or FILE.py:CLASS, holds.

    Raises InputError naming file, line and what is wrong.
    """
    told, _, name = where.partition(":")
    path = Path(told)
    name = name or DEFAULT_CLASS
    if path.suffix != ".py" or not path.is_file():
        raise InputError(f"firmware: {told}: no such file; expected FILE.py or FILE.py:CLASS")
    found = getattr(_module(path), name, None)
    if not isinstance(found, type) or not callable(getattr(found, "step", None)):
        raise InputError(f"{path}: no class {name!r} with a method 'step'; expected one")
    try:
        made: Steps = found(config)
    except Exception as error:
        raise InputError(_line(path, error)) from None
    return made


def absolute(where: str, folder: Path) -> str:
    """`where` with its file as seen from a folder."""
    told, colon, name = where.partition(":")
    return f"{(folder / told).resolve()}{colon}{name}"


def _module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(f"opc4_own_{path.stem}", path)
    assert spec is not None and spec.loader is not None  # it ends in .py
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses of the file look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(_line(path, error)) from None
    return module


def _line(path: Path, error: Exception) -> str:
    """One line for an error of the user's file, with the place in it."""
    number = getattr(error, "lineno", None)
    if number is None:
        own = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
        number = own[-1].lineno if own else 1
    text = " ".join(str(getattr(error, "msg", None) or error).split())
    return f"{path}:{number}: {type(error).__name__}: {text}; expected a file that runs"
