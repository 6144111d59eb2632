"""Measured against simulated: what is wrong, in which equation, why, and what it gains to know."""
