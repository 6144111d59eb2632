"""Identification as the thesis did it, and better: flow maps, friction, exponents, oil damper."""
