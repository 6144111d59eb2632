"""Loads of the gearbox on the stay: force barriers and the synchronizer's block (thesis 4.1.1).

Checked by: tests/physics/test_synchronizer.py
"""

from __future__ import annotations

from math import cos, pi

from plant.kernel.compiled import inlined


@inlined
def barrier(x_m, direction, stroke, mesh_n, x_mesh, w_mesh, pull_n, w_pull):
    """Force barrier that resists motion like friction [N]: F cos^2(pi u / 2), zero for |u| >= 1.

    Into gear (direction away from neutral): u = (|x| - x_mesh)/w_mesh; out of gear:
    u = (stroke - |x|)/w_pull.
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
