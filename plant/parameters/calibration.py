"""What a calibrated model file says of its values: how well they are known, and what they leave.

[posterior]: by quantity of `plant.effects.tolerances`, its row of the covariance up to its own column; logarithms,
seconds or, of what is limited, standard normal deviations. [posterior_truck]: by quantity of a truck, its standard
deviation. [discrepancy], [discrepancy_time]: by measured column, rms of what the model leaves beyond the noise,
correlation time.
"""

from __future__ import annotations

OF_TRUCK = {
    **dict.fromkeys(("friction", "flow_in", "flow_out", "volume_a", "volume_b"), "1"),
    **dict.fromkeys(("linkage", "mass"), "1"),
    **dict.fromkeys(("rise", "fall"), "s"),
}
COLUMNS = {
    "position_m": "m",
    "pressure_oil2_pa": "Pa",
    **{f"pressure_{name}_pa": "Pa" for name in "12BNF"},
}
UNITS = {
    **{
        f"posterior.{name}": "1"
        for name in (
            *("friction", "breakaway", "viscous", "mass", "spring", "rise", "fall", "flow_in"),
            *("flow_out", "critical", "volume_a", "volume_b", "kappa"),
            *("wall_heat", "wall_density", "wall_ends", "gauge_lag"),
        )
    },
    **{f"posterior_truck.{name}": unit for name, unit in OF_TRUCK.items()},
    **{f"discrepancy.{name}": unit for name, unit in COLUMNS.items()},
    **{f"discrepancy_time.{name}": "s" for name in COLUMNS},
}
"""Unit of every path; none is required."""
