"""The hybrid integrator: steps, modes, guards and resets, located exactly."""
