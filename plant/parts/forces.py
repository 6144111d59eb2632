"""Forces on the stay and pistons: set-valued friction (thesis 3.24, Table 3.1, with its errata), spring, detent, damper.

Also the barriers of the gearbox (thesis 4.1.1). Checked by: tests/physics/test_synchronizer.py, test_friction.py
"""

from __future__ import annotations

from math import cos, exp, pi, sin

from plant.kernel.compiled import inlined
from plant.kernel.layout import Slot
from plant.kernel.views import unlikely
from plant.parts.damper import damper_difference
from plant.parts.term import added, not_negative


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


@inlined
def sliding(speed_m_s, static_n, run_n, beta, stribeck_m_s):
    """Kinetic friction F_rf + beta |v| [N], with a Stribeck fall from static if a speed is given.

    The speed counts in the direction of motion: smooth through zero within a step that ends at the turn. Source: thesis
    3.1.5 (F_df); Stribeck term as in Armstrong-Helouvry 1991. Checked by: tests/physics/test_friction.py
    """
    level = run_n + beta * speed_m_s
    if stribeck_m_s > 0.0 and static_n > run_n:
        level += (static_n - run_n) * exp(-max(speed_m_s, 0.0) / stribeck_m_s)
    return level


@inlined
def direction_factor(direction, p):
    """Return the friction's asymmetry: 1 + a towards +, 1 - a towards -."""
    return 1.0 + p.asymmetry * direction


@inlined
def extra_drag(x, direction, p):
    """Return the stay's resistance by position: gearbox barrier, bump, linkage, damper mount [N]."""
    extra = p.f_linkage + p.damper_drag
    if p.mesh_force != 0.0 or p.pull_force != 0.0:
        extra += barrier(
            x, direction, p.stroke, p.mesh_force, p.x_mesh, p.w_mesh, p.pull_force, p.w_pull
        )
    if p.bump_force != 0.0:
        d = (x - p.bump_x) / p.bump_width
        extra += p.bump_force * exp(-0.5 * d * d)
    return extra


@inlined
def stay_sliding(x, v, direction, p):
    """Return the sliding friction of the stay in its direction of motion [N], >= 0."""
    level = sliding(direction * v, p.f_static_s, p.f_run_s, p.beta_s, p.stribeck_v)
    level = level * direction_factor(direction, p) + extra_drag(x, direction, p)
    if unlikely(p.adder != 0.0):
        level = not_negative(level + added(Slot.RESISTANCE, 0.0, x, abs(v), direction, 0.0, p))
    return level


@inlined
def stay_static(x, direction, p):
    """Return the breakaway friction of the stay towards a direction [N]: no less than kinetic (erratum 3.24)."""
    level = max(p.f_static_s, p.f_run_s) * direction_factor(direction, p)
    level += extra_drag(x, direction, p)
    if unlikely(p.adder != 0.0):
        level = not_negative(level + added(Slot.RESISTANCE, 0.0, x, 0.0, direction, 0.0, p))
    return level


@inlined
def seal_drag(difference_pa, p):
    """Return the friction of a piston seal grown by the pressure difference across it [N]."""
    return p.seal_mu * abs(difference_pa) * p.area_p


@inlined
def piston_sliding(v, direction, difference_pa, p):
    """Return the sliding friction of one piston [N]; v and direction are those of x_s."""
    level = sliding(direction * v, p.f_static_p, p.f_run_p, p.beta_p, p.stribeck_v)
    return level * direction_factor(direction, p) + seal_drag(difference_pa, p)


@inlined
def piston_static(direction, difference_pa, p):
    """Return the breakaway friction of one piston [N]: no less than kinetic (erratum 3.24)."""
    level = max(p.f_static_p, p.f_run_p) * direction_factor(direction, p)
    return level + seal_drag(difference_pa, p)
