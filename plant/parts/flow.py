"""Flow of mass and temperature, epsilon = T m_dot, through a valve (thesis 3.1.4).

`charge` and `discharge` are the mapped flows (two polynomials each, in the pressure ratio);
`orifice` is the theoretical flow 3.13/3.20 with its erratum corrected.
"""

from __future__ import annotations

from math import sqrt

from plant.kernel.compiled import inlined
from plant.kernel.layout import (
    C_HIGH,
    C_LOW,
    C_SLOPE,
    C_Y_MIN,
    C_Y_SPLIT,
    D_HIGH,
    D_LOW,
    D_SLOPE,
    D_Z_SPLIT,
)


@inlined
def charge(pressure_pa, supply_pa, c):
    """Mapped charge flow f_in(P) = P_s phi(P/P_s) [K kg/s]; negative above the supply.

    Source: thesis 3.1.4, 3.39; scaled with the supply pressure (errata 3.21, 3.39).
    Checked by: tests/physics/test_flow.py
    """
    per_supply = 1.0 / supply_pa  # one division for all chambers
    ratio = pressure_pa * per_supply
    y = max(ratio, c[C_Y_MIN])
    high = c[C_HIGH] + y * (c[C_HIGH + 1] + y * (c[C_HIGH + 2] + y * c[C_HIGH + 3]))
    low = c[C_LOW] + y * (c[C_LOW + 1] + y * (c[C_LOW + 2] + y * (c[C_LOW + 3] + y * c[C_LOW + 4])))
    back = c[C_SLOPE] * (y - 1.0)
    phi = high if y < c[C_Y_SPLIT] else (low if y <= 1.0 else back)
    return supply_pa * phi


@inlined
def discharge(pressure_pa, atmosphere_pa, c):
    """Mapped discharge flow f_out(P) = P_atm phi(P/P_atm) [K kg/s]; negative in suction.

    Source: thesis 3.1.4, 3.40.  Checked by: tests/physics/test_flow.py
    """
    per_atmosphere = 1.0 / atmosphere_pa  # one division for all chambers
    z = pressure_pa * per_atmosphere
    low = c[D_LOW] + z * (c[D_LOW + 1] + z * (c[D_LOW + 2] + z * (c[D_LOW + 3] + z * c[D_LOW + 4])))
    high = c[D_HIGH] + z * (c[D_HIGH + 1] + z * c[D_HIGH + 2])
    suction = c[D_SLOPE] * (z - 1.0)
    phi = suction if z < 1.0 else (low if z < c[D_Z_SPLIT] else high)
    return atmosphere_pa * phi


@inlined
def orifice(upstream_pa, downstream_pa, cda_m2, temperature_k, gamma, r_air):
    """Theoretical flow T m_dot of an orifice C_d A [K kg/s], choked below the critical ratio.

    3.13 choked, 3.20 free with the density factor outside the root (erratum 3.20); antisymmetric
    when the pressures change places.  Next to equal pressures (ratio above 0.999) the root is
    replaced by the odd cubic of the same value and slope there, so that the slope stays finite.

    Checked by: tests/physics/test_flow.py (continuity at 0.5283)
    """
    if upstream_pa >= downstream_pa:
        high = upstream_pa
        low = downstream_pa
        sign = 1.0
    else:
        high = downstream_pa
        low = upstream_pa
        sign = -1.0
    ratio = low / high
    critical = (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0))
    if ratio <= critical:
        value = sqrt(gamma * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (gamma - 1.0)))
    else:
        edge = min(ratio, 0.999)
        value = sqrt(
            2.0 * gamma / (gamma - 1.0) * (edge ** (2.0 / gamma) - edge ** ((gamma + 1.0) / gamma))
        )
        if ratio > 0.999:
            share = (1.0 - ratio) / 0.001
            value *= share * (1.25 - 0.25 * share * share)
    return sign * cda_m2 * high * sqrt(temperature_k / r_air) * value
