"""Loads on the stay: spring, constant force, detent, damper; the gearbox's barriers (thesis 4.1.1)."""

from __future__ import annotations

from math import cos, pi, sin

from plant.kernel.compiled import inlined
from plant.kernel.layout import Slot
from plant.kernel.views import unlikely
from plant.parts.damper import damper_difference
from plant.parts.term import added


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


@inlined
def loaded(force, t, x, v, side, oil_pa, m, p):
    """Return a force on the stay and all loads [N]; side: +1 or -1, on which the damper acts."""
    force += conservative_force(x, p)
    if m.damper != 0:
        force -= side * p.a_oil * damper_difference(side * x, side * v, oil_pa, m, p)
    if unlikely(p.adder != 0.0):
        force += added(Slot.FORCE, t, x, v, 0.0, 0.0, p)
    return force


@inlined
def store_loads(q, t, x, v, side, oil_pa, m, p):
    """Store the rates of the loads' quadratures."""
    q.damper = 0.0
    if m.damper != 0:
        q.damper = side * v * p.a_oil * damper_difference(side * x, side * v, oil_pa, m, p)
    q.external = conservative_force(x, p) * v
    if unlikely(p.adder != 0.0):
        q.external += added(Slot.FORCE, t, x, v, 0.0, 0.0, p) * v


@inlined
def barrier(x_m, direction, stroke, mesh_n, x_mesh, w_mesh, pull_n, w_pull):
    """Barrier that resists motion like friction [N]: F cos^2(pi u / 2), zero for |u| >= 1.

    Into gear (away from neutral) u = (|x| - x_mesh)/w_mesh, out of gear u = (stroke - |x|)/w_pull.
    """
    distance = abs(x_m)
    if direction * x_m >= 0.0:
        force = mesh_n
        u = (distance - x_mesh) / w_mesh
    else:
        force = pull_n
        u = (stroke - distance) / w_pull
    if force == 0.0 or abs(u) >= 1.0:
        return 0.0
    c = cos(0.5 * pi * u)
    return force * c * c
