"""The views of the records: `p = parameters(p)` makes an array or a plain view one with names."""

from __future__ import annotations

from plant.kernel.compiled import inlined
from plant.kernel.layout import (
    FIRST_PRESSURE,
    EventRow,
    FixedState,
    FlowMap,
    GridRow,
    Impact,
    LengthState,
    Modes,
    Parameters,
    PistonState,
    Quadratures,
)
from plant.kernel.views import named

parameters = named(Parameters)
modes = named(Modes)
flow_map = named(FlowMap)
fixed_state = named(FixedState)
length_state = named(LengthState)
piston_state = named(PistonState)
quadratures_of = named(Quadratures)
impact_of = named(Impact)
event_row = named(EventRow)
grid_row = named(GridRow)

FIRST_FIXED, FIRST_LENGTH = FIRST_PRESSURE


@inlined
def pressures(fixed, y):
    """Return the view of the chambers' pressures in a state."""
    return y[FIRST_FIXED:] if fixed else y[FIRST_LENGTH:]
