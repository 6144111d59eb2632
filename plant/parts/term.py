"""Terms in the slots of the equations: one by nodes on an even grid, others as compiled functions."""

# mypy: disallow-untyped-defs=False

from __future__ import annotations

from plant.kernel.compiled import called, inlined
from plant.kernel.layout import Over
from plant.kernel.views import call_at


@inlined
def term_value(p, variable):
    """Return the term: nodes joined by straight lines, constant outside [unit of its slot]."""
    count = int(p.term_count)
    place = (variable - p.term_low) / p.term_step
    if place <= 0.0:
        return p.term_nodes[0]
    if place >= count - 1:
        return p.term_nodes[count - 1]
    k = int(place)
    w = place - k
    return (1.0 - w) * p.term_nodes[k] + w * p.term_nodes[k + 1]


@inlined
def term_force(t, x, v, p):
    """Return the force of time, of position, or (as a resistance) of speed [N]."""
    if p.term_variable == Over.TIME:
        return term_value(p, t)
    if p.term_variable == Over.POSITION:
        return term_value(p, x)
    value = term_value(p, abs(v))
    return -value if v > 0.0 else (value if v < 0.0 else 0.0)


@inlined
def term_drag(x, speed, p):
    """Return the resistance of position or of speed [N]."""
    return term_value(p, x if p.term_variable == Over.POSITION else speed)


@inlined
def term_flow(t, x, pressure, p):
    """Return the flow of time, of position, or of the chamber's own pressure [K kg/s]."""
    if p.term_variable == Over.TIME:
        return term_value(p, t)
    return term_value(p, x if p.term_variable == Over.POSITION else pressure)


@called
def added_terms(slot, t, x, v, direction, pressure, p):
    """Return the sum of the functions that effects add in a slot [unit of the slot].

    What they depend on, by slot: `plant.effects.added_term.ARGUMENTS`.
    """
    total = 0.0
    for k in range(int(p.added_count)):
        row = p.added[k]
        if row[0] == slot:
            total += call_at(int(row[1]), t, x, v, direction, pressure, row[2:])
    return total
