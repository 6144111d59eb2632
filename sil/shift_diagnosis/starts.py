"""Where fits begin: sizes of causes, from small to large, tried in a usual truck.

A fit from a truck that is healthy only with unusual quantities ends in minima near to that truck. Here
a cause of each size is simulated once, and the truck's quantities follow by linear algebra.
Checked by: tests/unit/sil/shift_diagnosis/test_starts.py
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sil.shift_diagnosis.fit import UNABLE, Fitter
from sil.shift_diagnosis.linear import (
    Floats,
    Linear,
    Noise,
    linearise,
    prior_cost,
    residuals_of,
    weight_of,
)
from sil.shift_diagnosis.model import Cause, Point

SIZES: Final = (0.7, 1.5, 3.0, 5.0, 8.0, 13.0)
"""In typical ones."""
ROUNDS: Final = 4


def usual_starts(
    fitter: Fitter, causes: Sequence[Cause], noise_m: float
) -> dict[Cause, tuple[float, Floats]]:
    """Return for every cause half chi squared and the point [units + 1] where it is least.

    noise_m: of a position [m]; larger than the sensor's, because slopes are those of a healthy truck.
    """
    units = len(fitter.names)
    noise = Noise(position_m=noise_m, loads=fitter.noise.loads)
    usual = linearise(fitter.model, fitter.shifts, np.zeros(units), noise=noise)
    tried = [
        (cause, sign * size)
        for cause in causes
        for sign in ((1.0, -1.0) if cause.sign == 0 else (float(cause.sign),))
        for size in SIZES
    ]
    x, _v, done = fitter.model.predict(fitter.shifts, [Point({}, (item,)) for item in tried])
    found: dict[Cause, tuple[float, Floats]] = {}
    for k, (cause, size) in enumerate(tried):
        residuals = residuals_of(fitter.shifts, x[:, k])
        cost, values = _best_truck(usual, residuals, done[:, k])
        if cause not in found or cost < found[cause][0]:
            found[cause] = (cost, np.append(values, size))
    return found


def _best_truck(
    usual: Linear, residuals: Sequence[Floats], done: NDArray[np.bool_]
) -> tuple[float, Floats]:
    """Return half chi squared with the priors, and the truck's quantities [units] that make it least."""
    h, g, cost = np.zeros((usual.units, usual.units)), np.zeros(usual.units), 0.0
    for a, w, r, able in zip(usual.slopes, usual.weights, residuals, done, strict=True):
        if not able:
            cost += UNABLE
            continue
        h += a.T @ w @ a
        g += a.T @ (w @ r)
        cost += 0.5 * float(r @ w @ r)
    values: Floats = np.zeros(usual.units)
    for _ in range(ROUNDS):
        values = np.asarray(np.linalg.solve(h + np.diag(weight_of(values, usual.units)), g))
    return cost - float(g @ values - 0.5 * values @ h @ values) + prior_cost(values), values
