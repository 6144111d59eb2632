"""What the chambers hold against what the pistons sweep: a chamber must keep a volume."""

from __future__ import annotations

from collections.abc import Iterable

from plant.equations.fixed_piston import fixed_volumes
from plant.equations.length_stroke import length_volumes
from plant.errors import NoVolumeError
from plant.kernel.compiled import plain
from plant.kernel.layout import FIXED, Parameters
from plant.kernel.packing import CHAMBER_NAMES, Floats, initial_state, state_record

VOLUMES = ("vol_b", "vol_n", "vol_f")


def volumes_m3(system: int, p: Parameters, y: Floats) -> list[float]:
    """Volumes of the chambers in a state [m^3], in their order."""
    volumes = plain(fixed_volumes if system == FIXED else length_volumes)
    return [float(volume) for volume in volumes(state_record(system)(y), p)]


def ends_of_travel(
    system: int, p: Parameters, gears: Iterable[str] = ("N", "B", "F")
) -> list[Floats]:
    """Return states [states], SI units: the fixed piston at both stops, the length stroke in the gears."""
    if system == FIXED:
        end = float(p.stroke + p.stop_offset)
        return [initial_state(system, p, position=x, charged=()) for x in (0.0, end)]
    return [initial_state(system, p, position=gear, charged=()) for gear in gears]


def refuse_empty(
    system: int, p: Parameters, states: Iterable[Floats], chambers: Iterable[str] = "12BNF"
) -> None:
    """Raise NoVolumeError if a chamber has no volume left in one of the states [states], SI units."""
    message = emptied(system, p, states, chambers)
    if message:
        raise NoVolumeError(message)


def emptied(
    system: int,
    p: Parameters,
    states: Iterable[Floats],
    chambers: Iterable[str] = "12BNF",
    share: float = 0.0,
) -> str:
    """Return which chamber keeps no more than a share of its volume in states [states] (SI), and what it needs; or ""."""
    listed = list(states)
    volumes_of_states = [volumes_m3(system, p, y) for y in listed]
    for k, chamber in enumerate(CHAMBER_NAMES[system]):
        given_m3 = float(getattr(p, VOLUMES[k]))
        volume, worst = min((volumes[k], j) for j, volumes in enumerate(volumes_of_states))
        if chamber in chambers and not volume > share * abs(given_m3):
            body = "piston" if system == FIXED else "stay"
            return (
                f"{Parameters.fields[VOLUMES[k]].paths[system]}: {given_m3:.6g} m^3 leaves chamber "
                f"{chamber} no volume with the {body} at {1e3 * float(listed[worst][0]):.2f} mm; "
                f"expected more than {max(given_m3 - volume, 0.0):.6g}"
            )
    return ""
