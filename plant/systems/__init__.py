"""The two actuators composed: fixed piston and length stroke, from conditions to a simulated stroke."""
