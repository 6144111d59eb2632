"""An actuator built from the packed arrays, for closed forms: any number of it can be changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from plant.integrator.hybrid import HybridSystem
from plant.kernel import layout as L
from plant.kernel.packing import Load, flow_coefficients, initial_state, pack
from plant.parameters import load

MS = 1_000_000
NOMINAL = load()

# Numbers that leave bodies without air and friction.
AIRLESS = {L.AREA_P: 0.0, L.AREA_P2: 0.0, L.AREA_S: 0.0, L.K_IN: 0.0, L.K_OUT: 0.0}
SMOOTH = {
    L.F_STATIC_S: 0.0,
    L.F_RUN_S: 0.0,
    L.BETA_S: 0.0,
    L.F_STATIC_P: 0.0,
    L.F_RUN_P: 0.0,
    L.BETA_P: 0.0,
}
# Friction that holds everything.
STUCK = {L.F_STATIC_S: 1e6, L.F_STATIC_P: 1e6}


class Bare(HybridSystem):
    """One actuator at time 0: nominal, with packed numbers and states changed.

    changes: place in the parameter array -> number; state: place in the state -> number.
    """

    def __init__(
        self,
        system: int,
        changes: Mapping[int, float],
        state: Mapping[int, float] | None = None,
        *,
        place: str | float | None = None,
        charged: Sequence[str] = (),
        damper: str | None = None,
        tolerance: float = 1e-8,
    ) -> None:
        self.chambers = ("1", "2") if system == L.FIXED else ("B", "N", "F")
        load = Load(damper=damper)
        p = pack(NOMINAL, system, supply_pressure_pa=9e5, atmosphere_pa=101325.0, load=load)
        for index, value in changes.items():
            p[index] = value
        if place is None:
            place = 0.0 if system == L.FIXED else "N"
        y = initial_state(system, p, position=place, charged=charged, quadratures=L.QUADRATURES)
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
