"""The examples of the Python reference run, and every item of the page has one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sil
from can_dbc.errors import InputError, RunError
from can_dbc.messages import Gear, ShiftRequest
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.position import Calibration
from docs.generate import EXAMPLES, PYTHON_API
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import simulate

FILES = ("plan", "measured", "first", "out=", "own.py")
"""Words of the examples that need files or minutes."""


def test_every_item_has_an_example() -> None:
    items = {item.replace(":", ".") for group in PYTHON_API.values() for item in group}
    assert items == EXAMPLES.keys()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_examples_run(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {
        "np": np,
        "run": sil.run,
        "load": load,
        "simulate": simulate,
        "Gear": Gear,
        "InputError": InputError,
        "RunError": RunError,
        "Firmware": Firmware,
        "Inputs": Inputs,
        "FirmwareConfig": FirmwareConfig,
        "Calibration": Calibration,
        "ShiftRequest": ShiftRequest,
        "StrokeConditions": StrokeConditions,
        "LengthStroke": LengthStroke,
    }
    count = 0
    for path, text in EXAMPLES.items():
        if not any(word in text for word in FILES):
            exec(compile(text, path, "exec"), names)
            count += 1
    assert count > 12
    assert capsys.readouterr().out.startswith(
        "--set valve.D_fal: no such value; expected one of valve.D_fall"
    )
