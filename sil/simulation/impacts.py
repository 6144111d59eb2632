"""What counts as an impact: one definition for the metrics of runs, tunings and bounds.

An impact turns kinetic energy to heat: of the stay on a stop, of a piston on its stop, a nut or a collar.
Not counted: the stay on the synchronizer's block, and the driving piston's first contact, which picks up
the stay at rest. A stop is as soft as the hardest impact that counts.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

PICK_UP = {
    ("neutral", "backward"): ("collar_1_contact",),
    ("neutral", "forward"): ("collar_2_contact",),
    ("backward", "neutral"): ("nut_1_contact",),
    ("forward", "neutral"): ("nut_2_contact",),
    ("backward", "forward"): ("nut_1_contact", "collar_2_contact"),
    ("forward", "backward"): ("nut_2_contact", "collar_1_contact"),
}
"""Contacts by which the driving pistons pick up the stay on the way from one gear to another."""

HOLD_S = 0.05  # the stay has arrived when it is at its stop and remains there for this long


def counted(
    kind: NDArray[Any], time_s: Floats, energy_j: Floats, at_block: Bools, pick_up: Collection[Any]
) -> Bools:
    """Return which events [..., events] are impacts that count.

    kind: name or number of each event's contact; energy_j: kinetic energy lost in J; pick_up: kinds
    of contact of which the first does not count. An event that did not happen has no energy.
    """
    picks_up = np.zeros_like(at_block)
    for each in pick_up:
        times = np.where((kind == each) & (energy_j > 0.0), time_s, np.inf)
        first = times.min(axis=-1, initial=np.inf, keepdims=True)
        picks_up |= np.isfinite(times) & (times == first)
    counts: Bools = (energy_j > 0.0) & ~at_block & ~picks_up
    return counts


def worst_speed_m_s(energy_j: Floats, stay_m_s: Floats, moving_mass_kg: float) -> Floats:
    """Return the hardest impact as a speed of the stay in m/s.

    energy_j [n] in J: of the hardest impact; stay_m_s [n] in m/s: fastest stop of the stay;
    moving_mass_kg: of the stay, its load and one piston, which would lose that energy at that speed.
    """
    worst: Floats = np.maximum(np.sqrt(2.0 * energy_j / moving_mass_kg), stay_m_s)
    return worst
