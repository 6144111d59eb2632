"""The interlock of the two outer chambers, which would hold the stay between them if both filled."""

from __future__ import annotations

from can_dbc.messages import Chamber
from controller.settings import ControlConfig, nanoseconds
from controller.strategies import Duties


class Interlock:
    """Refuses to fill backward and forward together, or too soon one after the other."""

    def __init__(self, config: ControlConfig) -> None:
        self._duty_closed = config.duty_closed
        # a command acts for its whole period
        self._apart_ns = nanoseconds(config.shift.interlock_s) + config.period_ns
        self._energised_ns: list[int | None] = [None, None, None]

    def clear(self, now_ns: int, chamber: Chamber) -> bool:
        """Return whether a chamber has been off for the interlock time, closing valve included."""
        last_ns = self._energised_ns[chamber]
        return last_ns is None or now_ns - last_ns >= self._apart_ns

    def allows(self, now_ns: int, duties: Duties) -> bool:
        """Return whether the duties are duties and respect the interlock."""
        closed = self._duty_closed
        b, n, f = duties
        if not (0.0 <= b <= 1.0 and 0.0 <= n <= 1.0 and 0.0 <= f <= 1.0):
            return False
        if b > closed:
            return f <= closed and self.clear(now_ns, Chamber.F)
        return f <= closed or self.clear(now_ns, Chamber.B)

    def note(self, now_ns: int, duties: Duties, blown: Chamber) -> None:
        """Note which chambers are filled in this step: by a command, or blown."""
        for chamber, duty in zip((Chamber.B, Chamber.N, Chamber.F), duties, strict=True):
            if duty > self._duty_closed or chamber is blown:
                self._energised_ns[chamber] = now_ns
