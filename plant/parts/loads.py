"""Conservative loads on the stay: spring, constant force, detent."""

# mypy: disallow-untyped-defs=False

from __future__ import annotations

from math import pi, sin

from plant.kernel.compiled import inlined


@inlined
def conservative_force(x, p):
    """Spring, constant force and detent on the stay, in the direction of x [N]."""
    force = p.f_external - p.spring_k * (x - p.spring_x0)
    if p.detent_force != 0.0:
        stroke = p.stroke
        for k in range(-1, 2):
            d = (x - k * stroke) / p.detent_width
            if abs(d) < 1.0:
                force -= p.detent_force * sin(pi * d)
    return force
