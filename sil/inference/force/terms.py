"""What may act on a body besides mass, Coulomb and viscous friction and an offset.

Causes of the catalogue that a balance of forces can show, physics that belongs to no catalogue of
faults (springs, drag, errors of gauge or area), and functions without a form, which say where a
residual sits.
Checked by: tests/unit/sil/inference/force/test_diagnosis.py
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from plant.effects import CATALOGUE
from plant.effects.force_term import Floats, ForceTerm, Motion
from sil.inference.thresholds import UNNAMED


class Term(NamedTuple):
    """A candidate: an id of the vocabulary, its class, and its form."""

    id: str
    cause_class: str
    form: ForceTerm


def centred(motion: Motion) -> Floats:
    """Return the position from the middle of the travel [n] in m."""
    low, high = np.quantile(motion.position_m, (0.01, 0.99))
    return motion.position_m - 0.5 * float(low + high)


def _pressure(motion: Motion) -> Floats:
    return np.zeros(0) if motion.pressure_pa is None else motion.pressure_pa


def _direction(motion: Motion) -> Floats:
    return np.sign(motion.speed_m_s)


def terms() -> dict[str, Term]:
    """Return the candidates by name: effects of the catalogue and physics beyond it."""
    effects = {
        name: Term(name, item.cause_class, item.force)
        for name, item in CATALOGUE.items()
        if item.force is not None
    }
    spring = "a spring, or enclosed gas, whose dead volume and exponent cannot be separated"
    cubic = "a spring whose rate changes with deflection"
    drag = "resistance grows with the square of speed"
    gain = "force in proportion to pressure: error of area or gauge"
    area = "an effective area that changes with position"
    signed = partial(ForceTerm, sign=0)
    under_pressure = partial(signed, needs_pressure=True)
    stiffness = ForceTerm("stiffness_n_m", "N/m", spring, lambda m, _: centred(m))
    stiffness_cubic = signed("cubic_n_m3", "N/m^3", cubic, lambda m, _: centred(m) ** 3)
    quadratic = ForceTerm(
        "drag_n_s2_m2", "N s^2/m^2", drag, lambda m, _: m.speed_m_s * np.abs(m.speed_m_s)
    )
    pressure_gain = under_pressure("area_m2", "m^2", gain, lambda m, _: _pressure(m))
    geometry = under_pressure("area_per_m_m", "m", area, lambda m, _: _pressure(m) * centred(m))
    return effects | {
        "stiffness": Term("stiffness", "mechanics", stiffness),
        "stiffness_cubic": Term("stiffness_cubic", "mechanics", stiffness_cubic),
        "quadratic_drag": Term("quadratic_drag", "friction", quadratic),
        "pressure_gain": Term("pressure_gain", "gauge", pressure_gain),
        "pressure times position": Term(UNNAMED, "geometry", geometry),
    }


Over = Callable[[Motion], Floats]

SMOOTH: dict[str, tuple[str, Over, Over | None]] = {
    "speed": ("friction", lambda m: m.speed_m_s, None),
    "position": ("mechanics", lambda m: m.position_m, None),
    "position, against the motion": ("friction", lambda m: m.position_m, _direction),
    "pressure": ("gauge", _pressure, None),
    "pressure, against the motion": ("friction", _pressure, _direction),
    "position, in proportion to pressure": ("geometry", lambda m: m.position_m, _pressure),
}
"""Functions without a form: class, what they depend on, what they are multiplied by."""


def hats(values: Floats, factor: Floats | None = None) -> Floats:
    """Return hat functions over the quantiles of values [n], times a factor [n]: [n, 8]."""
    nodes = np.unique(np.quantile(values, np.linspace(0.005, 0.995, 8)))
    table = np.column_stack([np.interp(values, nodes, row) for row in np.eye(len(nodes))])
    return table if factor is None else table * factor[:, None]


def difference(base: Floats, column: Floats) -> float:
    """Return the share of a column [n] that orthonormal columns [n, k] cannot make up."""
    rest = column - base @ (base.T @ column)
    return float(np.linalg.norm(rest) / (np.linalg.norm(column) + 1e-300))
