"""The length stroke: stay, two sliding pistons, three chambers B | N | F (thesis 3.3.2).

Gear positions: N at 0, B at +stroke, F at -stroke.  Conventions: header of nominal.toml.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plant.equations.volumes import ends_of_travel, refuse_empty
from plant.errors import InputError
from plant.integrator.hybrid import DEFAULT_TOLERANCE, HybridSystem
from plant.kernel.layout import LENGTH, Quadratures
from plant.kernel.packing import Load, flow_coefficients, initial_state, pack
from plant.parameters import ParameterSet


class LengthStroke(HybridSystem):
    """The length stroke in motion, advanced in simulated nanoseconds.

    initial: gear at time 0, "N", "B" or "F"; supply_pressure_pa: absolute, None takes the set's; charged: chambers at
    the supply pressure with open valves; tolerance: of the integrator, relative to each state's scale. Raises
    InputError for a value outside its range. Checked by: tests/physics/test_length_stroke.py
    """

    chambers = ("B", "N", "F")
    columns = (
        *("position_m", "velocity_m_s", "piston_1_m", "piston_1_velocity_m_s"),
        *("piston_2_m", "piston_2_velocity_m_s", "pressure_B_pa", "pressure_N_pa"),
        *("pressure_F_pa", "spent_impulse_n_s", "pressure_oil2_pa", "line_pressure_pa"),
    )

    def __init__(
        self,
        parameters: ParameterSet,
        *,
        initial: str = "N",
        supply_pressure_pa: float | None = None,
        charged: Sequence[str] = (),
        load: Load = Load(),  # noqa: B008 - frozen
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        if initial not in self.chambers:
            raise InputError(f"initial gear {initial!r}: expected N, B or F")
        if supply_pressure_pa is None:
            supply_pressure_pa = parameters.value("supply.P_s")
        p = pack(
            parameters,
            LENGTH,
            supply_pressure_pa=supply_pressure_pa,
            atmosphere_pa=parameters.value("gas.P_atm"),
            load=load,
        )
        c = flow_coefficients(parameters)
        # delays of the valves belong to whoever moves them
        self.valve_delays_ns: tuple[int, int] | None = None
        has_line = False
        if parameters.effects:
            from plant.effects import apply_to_run

            setup = apply_to_run(parameters, p, c, supply_pressure_pa, load.damper != "none")
            self.valve_delays_ns = (setup.timing.rise_ns, setup.timing.fall_ns)
            has_line = setup.has_line
        # every shift sweeps chamber N; the others shrink in one gear only, which may never come
        refuse_empty(LENGTH, p, ends_of_travel(LENGTH, p), "N")
        y = initial_state(
            LENGTH, p, position=initial, charged=charged, quadratures=Quadratures.size
        )
        super().__init__(LENGTH, p, c, y, load, charged, tolerance, has_line=has_line)

    @property
    def pistons_m(self) -> tuple[float, float]:
        """Positions of piston 1 and 2, inward from their outer stops [m]."""
        return (float(self._state.x_1), float(self._state.x_2))

    @property
    def spent_impulse_n_s(self) -> float:
        """Impulse given to the synchronizer since it was armed [N s]."""
        return float(self._state.impulse)

    def set_sync_impulse(self, impulse_n_s: float) -> None:
        """Arm the synchronizer for the next engagement, near neutral. Raises ValueError for a negative impulse."""
        if not impulse_n_s >= 0.0:
            raise ValueError(f"synchronizer impulse {impulse_n_s}: expected 0 or more")
        self._p.sync_impulse = impulse_n_s
        self._state.impulse = 0.0
        self._choose_modes()

    def row(self) -> np.ndarray:
        """Return the present state [states] in SI units, in the order of `columns`."""
        return self._y[: self._n].copy()
