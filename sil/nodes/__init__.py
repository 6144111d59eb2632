"""Further nodes on the bus: driver, other traffic, intruder, clock drift, a user's own firmware."""
