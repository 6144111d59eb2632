"""Enclosed gas as a spring: whether its dead volume and its exponent can be determined separately.

F ~ ((L + 1) / (L + d))^n: d is the distance to the closed end over the travel, L the dead length over
it.  A short stroke shows n / (L + d) alone.
Checked by: tests/unit/sil/inference/force/test_rig.py
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from sil.campaign.campaign import Floats
from sil.inference.force.fit import Bank, Tried

SPRINGS = ("stiffness", "stiffness_cubic")
EXPONENTS = np.linspace(1.0, 1.7, 8)


def enclosed_gas(bank: Bank, leader: Tried) -> str:
    """Return why dead volume and exponent cannot be separated; empty if no gas acts, or they can."""
    if not set(leader.names) & set(SPRINGS):
        return ""
    others = bank.columns_of([group for group in leader.groups if group.name not in SPRINGS])
    base = np.linalg.qr(bank.columns[:, others])[0]
    record = bank.record
    x = record.filtered(record.raw.position_m)[record.judged]
    low, high = float(x.min()), float(x.max())
    target = bank.target - base @ (base.T @ bank.target)

    def left(column: Floats) -> float:
        rest = column - base @ (base.T @ column)
        return float(target @ target - (target @ rest) ** 2 / (rest @ rest))

    fits = []
    for distance in ((x - low) / (high - low), (high - x) / (high - low)):
        table = []
        for n in EXPONENTS:

            def gas(log_length: float, n: float = n, d: Floats = distance) -> float:
                return left((np.exp(log_length) + d) ** -n)

            fit = minimize_scalar(gas, bounds=(-4.0, 3.0), method="bounded")
            table.append((float(fit.fun), float(np.exp(fit.x))))
        fits.append(np.array(table).T)
    best, lengths = min(fits, key=lambda item: float(item[0].min()))
    least, straight = float(best.min()), left(x)
    spring = float(np.sum((bank.target - bank.model_n(leader)) ** 2))
    noise = least / leader.count
    # in squares gas leaves about as little as the spring; in log evidence, clearly less than a straight one
    if least > 1.1 * spring or 0.5 * (straight - least) < 9.0 * noise:
        return ""
    alike = np.flatnonzero(0.5 * (best - least) <= 4.0 * noise)
    n, dead_m = EXPONENTS[alike], lengths[alike] * (high - low)
    if len(alike) < 3:
        return ""
    return (
        "a spring that enclosed gas explains: its dead volume and exponent move together (exponents "
        f"{n.min():.1f} to {n.max():.1f} with dead lengths of {dead_m.min():.3g} to {dead_m.max():.3g} m "
        "explain it alike): a stroke over most of the volume, or the gas pressure at two dead volumes, "
        "would separate them"
    )
