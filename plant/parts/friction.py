"""Set-valued friction of stay and piston (thesis 3.24, Table 3.1, with its errata)."""

from __future__ import annotations

from math import exp

from plant.kernel.compiled import inlined


@inlined
def sliding(speed_m_s, static_n, run_n, beta, stribeck_m_s):
    """Kinetic friction F_rf + beta |v| [N], with a Stribeck fall from static if a speed is given.

    The speed counts in the direction of motion, so that the law goes on smoothly through zero
    within a step that ends at the turn.
    Source: thesis 3.1.5 (F_df); Stribeck term as in Armstrong-Helouvry 1991.
    Checked by: tests/physics/test_friction.py
    """
    level = run_n + beta * speed_m_s
    if stribeck_m_s > 0.0 and static_n > run_n:
        level += (static_n - run_n) * exp(-max(speed_m_s, 0.0) / stribeck_m_s)
    return level


@inlined
def breakaway(static_n, run_n):
    """Static friction in effect: never below the kinetic friction at 0+ [N] (erratum 3.24)."""
    return max(static_n, run_n)
