"""What the channels at hand can decide: detectability and isolability from structure.

The model's equations and the unknowns they hold form a bipartite graph.  The Dulmage-Mendelsohn
decomposition marks its overdetermined part: a fault is detectable if its equation is in it, and
isolable from another if its equation still does once the other's is taken out.  No numbers enter.

Source: Krysander and Frisk 2008, Sensor placement for fault diagnosis.
Checked by: tests/unit/sil/inference/campaign/test_structure.py
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from sil.inference.campaign.observations import StrokeObservation

Graph = Mapping[str, frozenset[str]]

FAULTS = {
    "force": "force balance of the stay",
    "driving chamber": "mass balance of the driving chamber",
    "passive chamber": "mass balance of the passive chamber",
    "valve": "valve timing",
    "supply": "supply",
    "damper": "oil damper",
    "potentiometer": "potentiometer",
    "driving gauge": "gauge of the driving chamber",
    "passive gauge": "gauge of the passive chamber",
    "internal sensor": "internal sensor and its clock",
}
"""Fault classes by the equation that they enter."""

SENSORS = {
    "position": ("potentiometer", "x"),
    "driving": ("driving gauge", "p_driving"),
    "passive": ("passive gauge", "p_passive"),
    "oil": ("oil gauge", "p_oil"),
    "internal": ("internal sensor", "x"),
}
"""The equation that a channel adds, and the unknown that it measures."""


def equations(channels: Iterable[str], has_damper: bool) -> dict[str, frozenset[str]]:
    """Equations of one stroke and the unknowns in each; a channel adds its own.

    Derivatives are taken as known functions of their signal: both count as one unknown.
    """
    oil = {"p_oil"} if has_damper else set()
    system = {
        "force": {"x", "p_driving", "p_passive"} | oil,
        "driving chamber": {"p_driving", "x", "u", "p_supply"},
        "passive chamber": {"p_passive", "x", "u"},
        "valve": {"u"},
        "supply": {"p_supply"},
    }
    if has_damper:
        system["damper"] = {"p_oil", "x"}
    for channel in SENSORS.keys() & set(channels):
        name, unknown = SENSORS[channel]
        if has_damper or channel != "oil":
            system[name] = {unknown}
    return {name: frozenset(unknowns) for name, unknowns in system.items()}


def overdetermined(graph: Graph) -> frozenset[str]:
    """Equations of the overdetermined part: those that an unmatched one reaches, alternating."""
    names = sorted(graph)
    unknowns = sorted(set().union(*graph.values()))
    if not unknowns:
        return frozenset(names)
    matrix = np.array([[name in graph[row] for name in unknowns] for row in names], dtype=np.int8)
    match = maximum_bipartite_matching(csr_matrix(matrix), perm_type="column")
    owner = {int(j): i for i, j in enumerate(match) if j >= 0}
    reached = {i for i, j in enumerate(match) if j < 0}
    queue = list(reached)
    while queue:
        i = queue.pop()
        for j in np.flatnonzero(matrix[i]):
            other = owner.get(int(j))
            if other is not None and other not in reached:
                reached.add(other)
                queue.append(other)
    return frozenset(names[i] for i in reached)


@dataclass(frozen=True)
class Structure:
    """Detectable faults, and the pairs (fault, other) of which one is isolable from the other."""

    channels: tuple[str, ...]
    faults: tuple[str, ...]
    detectable: frozenset[str]
    isolable: frozenset[tuple[str, str]]

    def groups(self) -> list[tuple[str, ...]]:
        """Return detectable faults that cannot be distinguished either way."""
        left = [fault for fault in self.faults if fault in self.detectable]
        found = []
        while left:
            first = left[0]
            apart = {f for f in left if {(first, f), (f, first)} & self.isolable}
            found.append(tuple(fault for fault in left if fault not in apart))
            left = [fault for fault in left if fault in apart]
        return found

    def sentence(self) -> str:
        """Return what can be decided, in one sentence, before anything is fitted."""
        if not self.detectable:
            return (
                f"with {', '.join(self.channels) or 'no channel'} alone nothing can be detected "
                "from structure: only sizes within the healthy tolerances speak"
            )
        hidden = [FAULTS[f] for f in self.faults if f not in self.detectable]
        groups = [group for group in self.groups() if len(group) > 1]
        text = f"channels {', '.join(self.channels)}: "
        text += "everything can be detected" if not hidden else f"not {', '.join(hidden)}"
        if len(groups) == 1 and len(groups[0]) == len(self.detectable):
            return text + ", but no two can be distinguished"
        if groups:
            pairs = "; ".join(" / ".join(FAULTS[f] for f in group) for group in groups)
            return text + f"; not distinguished by structure: {pairs}"
        return text + " and distinguished"


def analyse(channels: Sequence[str], has_damper: bool) -> Structure:
    """Return detectability and isolability of every fault class with these channels."""
    graph = equations(channels, has_damper)
    faults = tuple(name for name in FAULTS if name in graph)
    plus = overdetermined(graph)
    isolable = set()
    for other in faults:
        rest = {name: held for name, held in graph.items() if name != other}
        remaining = overdetermined(rest)
        isolable |= {(fault, other) for fault in faults if fault in remaining and fault != other}
    return Structure(
        tuple(channels), faults, frozenset(f for f in faults if f in plus), frozenset(isolable)
    )


def structure_of(strokes: Sequence[StrokeObservation]) -> Structure:
    """Structure with the channels that the campaign's strokes have."""
    known: dict[str, None] = {}
    for stroke in strokes:
        kinds = {f"pressure_{name}_pa": "passive" for name in stroke.setup.passive_chambers}
        kinds[f"pressure_{stroke.setup.charged_chamber}_pa"] = "driving"
        for channel in stroke.channels:
            name = kinds.get(channel.name, channel.kind)
            if name != "pressure":
                known[name] = None
        if stroke.internal is not None:
            known["internal"] = None
    damper = any(stroke.conditions.load == "damper" for stroke in strokes)
    return analyse(list(known), damper)
