"""Today's strategy: fill the chamber of the wanted position until it is confirmed."""

from __future__ import annotations

from controller.position import Estimate
from controller.strategies import Duties, ShiftContext, Strategy, one_chamber


class OpenLoop(Strategy):
    """Full duty on the charged chamber, whatever the position does (thesis 3.1.3, 6.1)."""

    def reset(self) -> None:
        """Nothing to forget."""

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the configured duty on the charged chamber and zero on the others."""
        return one_chamber(shift.charged, self.config.duty)
