"""The two Runge-Kutta steps as plain Python on equations with known solutions: order, dense output, stiffness."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from plant.integrator import steppers
from plant.integrator.loop import Run

Floats = NDArray[np.float64]
Rhs = Callable[[float, Floats], Floats]

PARTS = (
    "stage_1", "stage_2", "stage_3", "stage_4", "stage_5", "stage_6", "local_error",
    "error_norm", "explicit_step", "explicit_dense", "dense_element", "interpolate",
    "interpolated", "differentiate", "factorise", "solve", "stiff_stage", "stiff_step", "combined", "stiff_dense",
)  # fmt: skip


class Method:
    """One step of either method on a given equation."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stiff: bool, rhs: Rhs, count: int) -> None:
        plain = {name: getattr(steppers, name).py_func for name in PARTS}
        for name, function in plain.items():
            monkeypatch.setattr(steppers, name, function)

        def derivative(t, y, dy, *_rest):  # type: ignore[no-untyped-def]
            dy[:count] = rhs(t, y[:count])

        monkeypatch.setattr(steppers, "derivative", derivative)
        self.plain = SimpleNamespace(**plain)
        self.stiff, self.rhs, self.n = stiff, rhs, count
        self.run = Run.zeros()
        self.run.scale = 1.0
        self.run.tolerance = 1e-6

    def step(self, t: float, y: Floats, h: float) -> tuple[Floats, float]:
        """State after one step, and its error norm."""
        n, run, plain = self.n, self.run, self.plain
        run.y[:n] = y
        run.time, run.step = t, h
        one = SimpleNamespace(y=run.y, du=np.ones(3))
        if self.stiff:
            run.k[6, :n] = self.rhs(t, y)
            plain.differentiate(one, run, n, n, False, 0)
            run.time_rate[:n] = (self.rhs(t + 1e-6, y) - self.rhs(t - 1e-6, y)) / 2e-6
            norm = plain.stiff_step(one, run, n, n, False)
            plain.stiff_dense(run.y, run.y1, run.k, run.dense, n)
        else:
            run.k[0, :n] = self.rhs(t, y)
            norm = plain.explicit_step(one, run, n, n, False)
            plain.explicit_dense(h, run.y, run.y1, run.k, run.dense, n)
        return run.y1[:n].copy(), norm

    def march(self, y: Floats, end: float, count: int) -> Floats:
        """State at `end` after equal steps from 0."""
        h = end / count
        for i in range(count):
            y, _ = self.step(i * h, y, h)
        return y

    def inside(self, theta: float) -> Floats:
        """Dense output at a fraction of the last step."""
        out = np.zeros(self.n)
        self.plain.interpolate(theta, self.run.dense, out, self.n)
        return out


def swing(t: float, y: Floats) -> Floats:
    """Three equations with y0 = exp(sin t), y1 = 1/(1 + t), y2 = cos 2t + y0."""
    return np.array([y[0] * np.cos(t), -y[1] * y[1], y[0] * np.cos(t) - 2.0 * np.sin(2.0 * t)])


def swung(t: float) -> Floats:
    """Solution of `swing` from 0."""
    return np.array([np.exp(np.sin(t)), 1.0 / (1.0 + t), np.cos(2.0 * t) + np.exp(np.sin(t))])


def slope(errors: list[float]) -> float:
    """Order from errors at steps halved each time, by the last pair."""
    return float(np.log2(errors[-2] / errors[-1]))


@pytest.mark.parametrize(("stiff", "order"), [(False, 5), (True, 4)])
def test_order_of_convergence(monkeypatch: pytest.MonkeyPatch, stiff: bool, order: int) -> None:
    method = Method(monkeypatch, stiff, swing, 3)
    errors = [
        float(np.max(np.abs(method.march(swung(0.0), 1.0, count) - swung(1.0))))
        for count in (8, 16, 32, 64)
    ]
    assert order - 0.35 < slope(errors) < order + 0.75
    assert errors[-1] < 1e-9


@pytest.mark.parametrize(("stiff", "power"), [(False, 5), (True, 4)])
def test_error_of_the_dense_output_within_one_step(
    monkeypatch: pytest.MonkeyPatch, stiff: bool, power: int
) -> None:
    method = Method(monkeypatch, stiff, swing, 3)
    errors = []
    for h in (0.2, 0.1, 0.05):
        y1, _ = method.step(0.4, swung(0.4), h)
        places = np.linspace(0.0, 1.0, 21)
        errors.append(
            max(float(np.max(np.abs(method.inside(x) - swung(0.4 + x * h)))) for x in places)
        )
        assert method.inside(0.0) == pytest.approx(swung(0.4), abs=1e-15)
        assert method.inside(1.0) == pytest.approx(y1, abs=1e-15)
    assert slope(errors) == pytest.approx(power, abs=0.3)


@pytest.mark.parametrize(("stiff", "order"), [(False, 5), (True, 4)])
def test_error_estimate_shrinks_with_its_order(
    monkeypatch: pytest.MonkeyPatch, stiff: bool, order: int
) -> None:
    method = Method(monkeypatch, stiff, swing, 3)
    norms = [method.step(0.4, swung(0.4), h)[1] for h in (0.2, 0.1, 0.05)]
    assert slope(norms) == pytest.approx(order, abs=0.5)


@pytest.mark.parametrize("rate", [1e4, 1e7, 1e10])
def test_stiff_method_is_l_stable(monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
    y1, _ = Method(monkeypatch, True, lambda _t, y: -rate * y, 1).step(0.0, np.array([1.0]), 1.0)
    assert abs(y1[0]) < 20.0 / rate


def test_stiff_method_follows_a_slow_solution_beside_a_fast_decay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def rhs(t: float, y: Floats) -> Floats:
        return np.array([-1e6 * (y[0] - np.cos(t)) - np.sin(t), y[0]])

    end = Method(monkeypatch, True, rhs, 2).march(np.array([1.0, 0.0]), 2.0, 40)
    assert end == pytest.approx([np.cos(2.0), np.sin(2.0)], abs=1e-4)


def test_linear_solver_pivots() -> None:
    # diagonal I - J with a zero on its diagonal
    jac = np.array([[1.0, -2.0, 0.5], [-3.0, 0.25, 1.0], [0.0, -1.0, -4.0]])
    run = Run.zeros()
    run.jacobian[:3, :3] = jac
    steppers.factorise.py_func(run, 3, 1.0)
    right = np.array([1.0, -2.0, 3.0])
    x = right.copy()
    steppers.solve.py_func(run, x, 3, 3, 1.0)
    assert (np.eye(3) - jac) @ x == pytest.approx(right, abs=1e-13)
