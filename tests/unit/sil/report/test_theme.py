"""The palettes: lines of one panel stay apart for every kind of colour vision."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from sil.report.theme import SERIES, THEMES

# Machado, Oliveira, Fernandes 2009, severity 1; on linear light
VISION = {
    "normal": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
LEAST_APART = 10.0
"""CIE 1976 colour difference; one of 2.3 is just seen."""


def lab(colour: str, vision: str) -> NDArray[np.float64]:
    """CIELAB of an sRGB colour as it is seen."""
    coded = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(VISION[vision]) @ light, 0.0, 1.0)
    x, y, z = TO_XYZ @ seen / np.array([0.9505, 1.0, 1.089])
    fx, fy, fz = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16.0 / 116.0 for v in (x, y, z))
    return np.array([116.0 * fy - 16.0, 500.0 * (fx - fy), 200.0 * (fy - fz)])


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("theme", THEMES.values(), ids=list(THEMES))
def test_lines_that_share_a_panel_stay_apart(theme: dict[str, str], vision: str) -> None:
    panels = (
        ["truth", "estimate", "alarm"],
        list("BNF"),
        ["measured", "before", "after"],
        [f"series{k}" for k in range(SERIES)],
    )
    for roles in panels:
        colours = [theme[role] for role in roles]
        for one, other in combinations(colours, 2):
            apart = np.linalg.norm(lab(one, vision) - lab(other, vision))
            assert apart > LEAST_APART, (one, other)


def test_the_measure_sees_what_a_dichromat_does_not() -> None:
    red, green = "#c04040", "#6f7a00"
    normal, deutan = (
        np.linalg.norm(lab(red, v) - lab(green, v)) for v in ("normal", "deuteranopia")
    )
    assert deutan < 0.4 * normal
    assert lab("#ffffff", "normal") == pytest.approx([100.0, 0.0, 0.0], abs=0.1)
