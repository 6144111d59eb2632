"""The continuous hybrid model of the actuator: chambers, valves, friction, pistons, damper."""
