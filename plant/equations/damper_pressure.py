"""One equation at a time: the damper's pressure from a known motion.

Checked by: tests/physics/test_one_equation.py
"""

from __future__ import annotations

from plant.kernel.compiled import kernel
from plant.kernel.record_views import parameters
from plant.parts.damper import damper_outlet, steady_difference


@kernel
def steady_oil_pressure(position, velocity, p, out):
    """Absolute pressure of the incompressible damper's chamber two [Pa] along a motion -> out.

    position [m] and velocity [m/s] of the stay; it acts on the way out from 0 (3.34).
    """
    p = parameters(p)
    for i in range(len(position)):
        side = 1.0 if position[i] > 0.0 or (position[i] == 0.0 and velocity[i] >= 0.0) else -1.0
        speed = side * velocity[i]
        outlet = damper_outlet(abs(position[i]), speed, p)
        out[i] = p.p_atm + steady_difference(speed, p.a_oil, outlet, 1.0, p.rho_oil)
