"""A change of a watched truck, and its name.

Checked by: tests/unit/sil/shift_diagnosis/test_track.py, test_confirm.py
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import msgspec

SEPARABLE: Final = 9.0
"""Chi squared by which the changes of two parameters must differ to be distinguished."""
LINEAR: Final = 0.05
"""Share of a change's chi squared that the linear model may be wrong by."""
LEFT: Final = 2.0
"""Most of what the best explanation leaves by which another may be worse and still the true one."""


class Change(msgspec.Struct, kw_only=True):
    """A step or the begin of a drift. Numbers of shifts count from the truck's first, 0.

    shift: the first one after the change, low to high its 95 % interval; time_s: when that was;
    found: the shift after which it was found. sigma: standard deviations. alike: parameters whose
    change the shifts cannot distinguish from this one. since: from which shift on it is dated; -1: not again.
    """

    name: str
    kind: str
    shift: int
    low: int
    high: int
    time_s: float
    found: int
    sigma: float
    alike: list[str]
    since: int = 0


Confirm = Callable[[Change], Change | None]


def renamed(change: Change, costs: Mapping[str, float]) -> Change:
    """Return a change named by the parameter that explains it best.

    costs: chi squared of the shifts after it, by name, each parameter moved as far as is best. What
    the best one leaves shows by how much such a fit can be wrong.
    """
    name = min(costs, key=costs.__getitem__)
    best = costs[name]
    near = best + max(SEPARABLE, min(LINEAR * (max(costs.values()) - best), LEFT * best))
    alike = [other for other, cost in costs.items() if other != name and cost < near]
    return msgspec.structs.replace(change, name=name, alike=alike)
