"""Where fits begin: sizes of causes, from small to large, tried in a truck.

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
    point_of,
    prior_cost,
    residuals_of,
    weight_of,
)
from sil.shift_diagnosis.model import Cause, Point

SIZES: Final = (0.7, 1.5, 3.0, 5.0, 8.0, 13.0)
"""In typical ones."""
ROUNDS: Final = 4


def starts_around(
    fitter: Fitter, causes: Sequence[Cause], noise_m: float, truck: Floats | None = None
) -> dict[Cause, list[tuple[float, Floats]]]:
    """Return for every cause half chi squared and the point [units + 1] of each size, the best first.

    truck: the quantities [units] that sizes are tried with, in prior deviations; a usual truck's
    where none are given. noise_m: of a position [m]; larger than the sensor's, because slopes are
    those of a truck without the cause.
    """
    truck = np.zeros(len(fitter.names)) if truck is None else truck
    noise = Noise(position_m=noise_m, loads=fitter.noise.loads)
    linear = linearise(fitter.model, fitter.shifts, truck, noise=noise)
    tried = [
        (cause, sign * size)
        for cause in causes
        for sign in ((1.0, -1.0) if cause.sign == 0 else (float(cause.sign),))
        for size in SIZES
    ]
    amounts = point_of(fitter.model, fitter.names, truck)
    x, _v, done = fitter.model.predict(fitter.shifts, [Point(amounts, (item,)) for item in tried])
    found: dict[Cause, list[tuple[float, Floats]]] = {}
    for k, (cause, size) in enumerate(tried):
        residuals = residuals_of(fitter.shifts, x[:, k])
        cost, values = _best_truck(linear, residuals, done[:, k])
        found.setdefault(cause, []).append((cost, np.append(values, size)))
    return {cause: sorted(own, key=lambda item: item[0]) for cause, own in found.items()}


def _best_truck(
    linear: Linear, residuals: Sequence[Floats], done: NDArray[np.bool_]
) -> tuple[float, Floats]:
    """Return half chi squared with the priors, and the truck's quantities [units] that make it least."""
    h, g, cost = np.zeros((linear.units, linear.units)), np.zeros(linear.units), 0.0
    for a, w, r, able in zip(linear.slopes, linear.weights, residuals, done, strict=True):
        if not able:
            cost += UNABLE
            continue
        h += a.T @ w @ a
        g += a.T @ (w @ r)
        cost += 0.5 * float(r @ w @ r)
    truck = linear.values[: linear.units]
    values = truck.copy()
    for _ in range(ROUNDS):
        weights = np.diag(weight_of(values, linear.units))
        values = np.asarray(np.linalg.solve(h + weights, g + h @ truck))
    step = values - truck
    return cost - float(g @ step - 0.5 * step @ h @ step) + prior_cost(values), values
