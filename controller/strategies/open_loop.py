"""Today's strategy, which fills the chamber of the wanted position until it is confirmed, and one that cuts the blow."""

from __future__ import annotations

from typing import Annotated

from can_dbc.messages import Gear
from controller.position import Estimate
from controller.settings import Settings, bounded
from controller.strategies import Duties, ShiftContext, Strategy, one_chamber


class OpenLoop(Strategy):
    """Full duty on the charged chamber, whatever the position does (thesis 3.1.3, 6.1)."""

    def reset(self) -> None:
        """Nothing to forget."""

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the configured duty on the charged chamber and zero on the others."""
        return one_chamber(shift.charged, self.config.duty)


class BlowCutParameters(Settings, frozen=True):
    """How long the blow still lasts, in either case at most as configured."""

    neutral_s: Annotated[float, bounded(0.0, 0.25, "s")] = 0.0
    """After neutral is confirmed on the way to a gear."""
    otherwise_s: Annotated[float, bounded(0.0, 0.25, "s")] = 0.25
    """After a shift has ended, in gear or in neutral."""


class BlowCut(OpenLoop):
    """Open loop whose blow on neutral ends early when a gear is to follow (thesis 6.1).

    Pressure left in the neutral chamber costs the next engagement 50-100 ms; it also cushions it. A choice of duty.
    """

    Parameters = BlowCutParameters
    parameters: BlowCutParameters

    def blow_s(self, configured_s: float, leg: Gear, follows: bool) -> float:
        """Return the shorter of the configured blow and this strategy's."""
        parameters = self.parameters
        limit_s = (
            parameters.neutral_s if leg is Gear.NEUTRAL and follows else parameters.otherwise_s
        )
        return min(configured_s, limit_s)
