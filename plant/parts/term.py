"""Terms that effects add in slots of the equations: compiled functions, called by addresses in the parameters."""

from __future__ import annotations

from plant.kernel.compiled import inlined
from plant.kernel.layout import Parameters
from plant.kernel.views import call_at, call_compiled, moved_pointer

COUNT, ROWS, VALUES = (Parameters.fields[n].start for n in ("added_count", "added", "added_values"))
ROW = Parameters.fields["added"].row

TIME, POSITION, SPEED, DIRECTION, PRESSURE, AGAINST_MOTION = range(1, 7)
"""Arguments of a term (all but the last); the valve's position takes the place of the direction."""


@inlined
def added(slot, t, x, v, direction, pressure, p):
    """Return the sum of the terms in a slot [its unit]; arguments: `plant.effects.added_term.ARGUMENTS`."""
    return call_at(int(p.adder), slot, t, x, v, direction, pressure, p)


@inlined
def not_negative(value):
    """Return a value, 0 for a negative one; a term that is not a number must end the stroke."""
    return 0.0 if value < 0.0 else value


def sum_of_terms(slot, t, x, v, direction, pressure, p):
    """Return the sum of the terms in a slot; p: pointer to the stroke's parameters."""
    total = 0.0
    for k in range(int(p[COUNT])):
        row = ROWS + k * ROW
        if p[row] == slot:
            values = moved_pointer(p, VALUES + int(p[row + 2]))
            total += call_compiled(int(p[row + 1]), slot, t, x, v, direction, pressure, values)
    return total


def tabulated(slot, t, x, v, direction, pressure, values):
    """Return a term by its values on an even grid, joined by straight lines, constant outside.

    values: what it depends on (TIME, POSITION, SPEED or PRESSURE; AGAINST_MOTION: a force of the
    speed's size that acts against it); lower end and step of the grid; how many nodes; the nodes.
    """
    over = values[0]
    sign = 1.0
    variable = pressure
    if over == TIME:
        variable = t
    elif over == POSITION:
        variable = x
    elif over == SPEED:
        variable = v
    elif over == AGAINST_MOTION:
        variable = abs(v)
        sign = -1.0 if v > 0.0 else (1.0 if v < 0.0 else 0.0)
    count = int(values[3])
    place = (variable - values[1]) / values[2]
    if place <= 0.0:
        return sign * values[4]
    if place >= count - 1:
        return sign * values[3 + count]
    k = int(place)
    w = place - k
    return sign * ((1.0 - w) * values[4 + k] + w * values[5 + k])
