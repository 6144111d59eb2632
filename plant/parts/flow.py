"""Flow of mass and temperature, epsilon = T m_dot, through a valve (thesis 3.1.4).

`charge`, `discharge`: mapped; `orifice`: theoretical, 3.13/3.20 with its erratum corrected; `iso_6358`: by a data
sheet.
"""

from __future__ import annotations

from math import sqrt

from plant.kernel.compiled import inlined
from plant.parameters.cylinder import CHOKED


@inlined
def charge(pressure_pa, supply_pa, c):
    """Return the mapped charge flow f_in(P) = P_s phi(P/P_s) [K kg/s]; negative above the supply.

    Source: thesis 3.1.4, 3.39, scaled with the supply pressure (errata 3.21, 3.39). Checked by:
    tests/physics/test_flow.py
    """
    per_supply = 1.0 / supply_pa  # one division for all chambers
    ratio = pressure_pa * per_supply
    y = max(ratio, c.y_min)
    high = c.charge_high[0] + y * (c.charge_high[1] + y * (c.charge_high[2] + y * c.charge_high[3]))
    low = c.charge_low[0] + y * (
        c.charge_low[1] + y * (c.charge_low[2] + y * (c.charge_low[3] + y * c.charge_low[4]))
    )
    back = c.charge_slope * (y - 1.0)
    phi = high if y < c.y_split else (low if y <= 1.0 else back)
    return supply_pa * phi


@inlined
def discharge(pressure_pa, atmosphere_pa, c):
    """Return the mapped discharge flow f_out(P) = P_atm phi(P/P_atm) [K kg/s]; negative in suction.

    Source: thesis 3.1.4, 3.40.  Checked by: tests/physics/test_flow.py
    """
    per_atmosphere = 1.0 / atmosphere_pa  # one division for all chambers
    z = pressure_pa * per_atmosphere
    low = c.discharge_low[0] + z * (
        c.discharge_low[1]
        + z * (c.discharge_low[2] + z * (c.discharge_low[3] + z * c.discharge_low[4]))
    )
    high = c.discharge_high[0] + z * (c.discharge_high[1] + z * c.discharge_high[2])
    suction = c.discharge_slope * (z - 1.0)
    phi = suction if z < 1.0 else (low if z < c.z_split else high)
    return atmosphere_pa * phi


@inlined
def orifice(upstream_pa, downstream_pa, cda_m2, temperature_k, gamma, r_air):
    """Theoretical flow T m_dot of an orifice C_d A [K kg/s], choked below the critical ratio.

    3.13 choked, 3.20 free with the density factor outside the root (erratum 3.20); antisymmetric in the pressures.
    Next to equal ones (ratio above 0.999) the root is replaced by the odd cubic of the same value and slope there: a
    finite slope. Checked by: tests/physics/test_flow.py (continuity at 0.5283)
    """
    if upstream_pa == downstream_pa:
        return 0.0
    if upstream_pa >= downstream_pa:
        high = upstream_pa
        low = downstream_pa
        sign = 1.0
    else:
        high = downstream_pa
        low = upstream_pa
        sign = -1.0
    ratio = low / high
    edge = min(max(ratio, 0.0), 0.999)
    is_choked = edge < 0.25  # at any gamma up to 5: saves a power
    density = 0.0 if is_choked else edge ** (1.0 / gamma)
    if is_choked or 2.0 * density >= (gamma + 1.0) * edge:  # the root below rises no further
        value = sqrt(gamma * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (gamma - 1.0)))
    else:
        value = sqrt(2.0 * gamma / (gamma - 1.0) * density * (density - edge))
        if ratio > 0.999:
            share = (1.0 - ratio) / 0.001
            value *= share * (1.25 - 0.25 * share * share)
    return sign * cda_m2 * high * sqrt(temperature_k / r_air) * value


@inlined
def iso_6358(upstream_pa, downstream_pa, cda_m2, critical, upstream_k, downstream_k, r_air):
    """Return T m_dot of a valve by ISO 6358 [K kg/s]; antisymmetric when the pressures change places.

    C is that of a choked orifice C_d A; below the critical ratio b the flow is constant, above it follows the ellipse
    sqrt(1 - ((r - b) / (1 - b))^2). T is that of the side the air comes from. Next to equal pressures as in `orifice`.
    Source: ISO 6358-1. Checked by: tests/physics/test_cylinder.py
    """
    if upstream_pa >= downstream_pa:
        high, low, kelvin, sign = upstream_pa, downstream_pa, upstream_k, 1.0
    else:
        high, low, kelvin, sign = downstream_pa, upstream_pa, downstream_k, -1.0
    ratio = low / high
    value = CHOKED
    if ratio > critical:
        beyond = (min(ratio, 0.999) - critical) / (1.0 - critical)
        value *= sqrt(1.0 - beyond * beyond)
    if ratio > 0.999:
        share = (1.0 - ratio) / 0.001
        value *= share * (1.25 - 0.25 * share * share)
    return sign * cda_m2 * high * sqrt(kelvin / r_air) * value
