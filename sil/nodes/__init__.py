"""Further nodes on the bus: driver, other traffic, intruder, clock drift."""
