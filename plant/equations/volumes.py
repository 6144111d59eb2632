"""What the chambers hold against what the pistons sweep: a chamber must keep a volume.

Checked by: tests/unit/plant/equations/test_volumes.py
"""

from __future__ import annotations

from collections.abc import Iterable

from plant.equations.fixed_piston import fixed_volumes
from plant.equations.length_stroke import length_volumes
from plant.errors import NoVolumeError
from plant.kernel import layout as L
from plant.kernel.packing import Floats, initial_state

HELD = {
    L.FIXED: (("1", "fixed.V10", L.VOL_B), ("2", "fixed.V20", L.VOL_N)),
    L.LENGTH: (
        ("B", "length.V_B0", L.VOL_B),
        ("N", "length.V_N0", L.VOL_N),
        ("F", "length.V_F0", L.VOL_F),
    ),
}


def volumes_m3(system: int, p: Floats, y: Floats) -> list[float]:
    """Volumes of the chambers in a state [m^3], in their order."""
    plain = (fixed_volumes if system == L.FIXED else length_volumes).py_func  # type: ignore[attr-defined]
    return [float(volume) for volume in plain(y, p)]


def ends_of_travel(system: int, p: Floats, gears: Iterable[str] = ("N", "B", "F")) -> list[Floats]:
    """States of the fixed piston at both its stops, of the length stroke in the gears."""
    if system == L.FIXED:
        end = float(p[L.STROKE] + p[L.STOP_OFFSET])
        return [initial_state(system, p, position=x, charged=()) for x in (0.0, end)]
    return [initial_state(system, p, position=gear, charged=()) for gear in gears]


def refuse_empty(
    system: int, p: Floats, states: Iterable[Floats], chambers: Iterable[str] = "12BNF"
) -> None:
    """Raise NoVolumeError if a chamber has no volume left in one of the states."""
    message = emptied(system, p, states, chambers)
    if message:
        raise NoVolumeError(message)


def emptied(
    system: int,
    p: Floats,
    states: Iterable[Floats],
    chambers: Iterable[str] = "12BNF",
    share: float = 0.0,
) -> str:
    """Which chamber keeps no more than a share of its parameter's volume, and what it needs; or ""."""
    listed = list(states)
    held = [volumes_m3(system, p, y) for y in listed]
    for k, (chamber, path, place) in enumerate(HELD[system]):
        volume, worst = min((volumes[k], j) for j, volumes in enumerate(held))
        if chamber in chambers and not volume > share * abs(float(p[place])):
            body = "piston" if system == L.FIXED else "stay"
            return (
                f"{path}: {float(p[place]):.6g} m^3 leaves chamber {chamber} no volume with the "
                f"{body} at {1e3 * float(listed[worst][0]):.2f} mm; "
                f"expected more than {max(float(p[place]) - volume, 0.0):.6g}"
            )
    return ""
