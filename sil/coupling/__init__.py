"""Coupling of the participants: simulated time, bus, faults, lockstep, transports."""
