"""Front end: measured strokes of the actuator, of the fixed piston, of a user's own cylinder."""
