"""The model file of an ordinary cylinder, stated by its dimensions."""

from __future__ import annotations

from pathlib import Path

VALUES = {
    "acting": (1.0, "-"),
    "bore": (0.032, "m"),
    "rod": (0.012, "m"),
    "stroke": (0.05, "m"),
    "dead_volume_1": (5e-6, "m^3"),
    "dead_volume_2": (5e-6, "m^3"),
    "mass": (0.6, "kg"),
    "breakaway": (20.0, "N"),
    "coulomb": (15.0, "N"),
    "viscous": (30.0, "N s/m"),
    "spring_rate": (800.0, "N/m"),
    "spring_preload": (40.0, "N"),
    "valve_cda_in": (4e-6, "m^2"),
    "valve_cda_out": (5e-6, "m^2"),
    "tube_length": (1.0, "m"),
    "tube_diameter": (0.004, "m"),
}
OPTIONAL = {
    "valve_c_in": "m^3/(s Pa)",
    "valve_b": "-",
    "wall_heat": "W/(m^2 K)",
    "wall_density": "-",
    "wall_ends": "-",
    "kappa": "-",
}


def model(folder: Path, **changes: float) -> Path:
    """Write cylinder.toml with these values changed; return its path."""
    lines = ["[base]", 'model = "nominal"', "[cylinder]"]
    stated = VALUES | {
        name: (changes[name], OPTIONAL[name]) for name in OPTIONAL if name in changes
    }
    if "valve_c_in" in changes:
        del stated["valve_cda_in"]
    for name, (value, unit) in stated.items():
        lines.append(
            f'{name} = {{ value = {changes.get(name, value)!r}, unit = "{unit}", source = "test" }}'
        )
    path = folder / "cylinder.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
