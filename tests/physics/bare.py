"""An actuator built from the packed arrays, for closed forms: any number of it can be changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from plant.integrator.hybrid import HybridSystem
from plant.kernel.layout import FIXED, Parameters, Quadratures
from plant.kernel.packing import Load, flow_coefficients, initial_state, pack
from plant.parameters import load

MS = 1_000_000
NOMINAL = load()

# Numbers that leave bodies without air and friction.
AIRLESS = {
    Parameters.area_p: 0.0, Parameters.area_p2: 0.0, Parameters.area_s: 0.0, Parameters.k_in: 0.0,
    Parameters.k_out: 0.0,
}  # fmt: skip
SMOOTH = {
    Parameters.f_static_s: 0.0, Parameters.f_run_s: 0.0, Parameters.beta_s: 0.0,
    Parameters.f_static_p: 0.0, Parameters.f_run_p: 0.0, Parameters.beta_p: 0.0,
}  # fmt: skip
# Friction that holds everything.
STUCK = {Parameters.f_static_s: 1e6, Parameters.f_static_p: 1e6}


class Bare(HybridSystem):
    """One actuator at time 0, nominal but for changes (place in the parameters -> number) and state (place -> number)."""

    def __init__(
        self,
        system: int,
        changes: Mapping[int, float],
        state: Mapping[int, float] | None = None,
        *,
        place: str | float | None = None,
        charged: Sequence[str] = (),
        damper: str = "none",
        tolerance: float = 1e-8,
    ) -> None:
        self.chambers = ("1", "2") if system == FIXED else ("B", "N", "F")
        load = Load(damper=damper)
        p = pack(NOMINAL, system, supply_pressure_pa=9e5, atmosphere_pa=101325.0, load=load)
        for index, value in changes.items():
            p[index] = value
        if place is None:
            place = 0.0 if system == FIXED else "N"
        y = initial_state(system, p, position=place, charged=charged, quadratures=Quadratures.size)
        for index, value in (state or {}).items():
            y[index] = value
        super().__init__(system, p, flow_coefficients(NOMINAL), y, load, charged, tolerance)

    def state(self, index: int) -> float:
        """One number of the present state."""
        return float(self._y[index])

    def samples(self, until_s: float, count: int, switches: Sequence[tuple[int, int, float]] = ()):  # type: ignore[no-untyped-def]
        """Advance, sampled evenly: times [count] and states [count, n]."""
        instants = np.linspace(self.now_ns, round(until_s * 1e9), count).astype(np.int64)
        return instants / 1e9, self.advance(int(instants[-1]), switches, instants)

    def names(self) -> list[str]:
        """Names of the events so far."""
        return [event.name for event in self.events]
