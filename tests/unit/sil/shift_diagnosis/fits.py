"""Causes by name, shifts of a log, and fits of them, for the tests of this folder."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from plant.parameters import load
from sil.shift_diagnosis.fit import Fitter, fits_of
from sil.shift_diagnosis.model import (
    Cause,
    catalogue,
)
from sil.shift_diagnosis.search import (
    final_fit,
)
from sil.shift_diagnosis.shifts import RecordedShift, shifts_of
from sil.shift_diagnosis.verdict import Judged


def only(name: str) -> Cause:
    return next(cause for cause in catalogue() if cause.effect.id == name)


def cut(path: Path) -> list[RecordedShift]:
    return list(shifts_of(str(path), load("nominal"), None, Counter()))


def judged(whole: Fitter, cause: Cause | None, start: np.ndarray) -> Judged:
    return Judged.of(final_fit(whole, cause, start))


in_turn = partial(fits_of, workers=1)
"""Fits one after another in this process."""
