"""Base of the strategies that brake the stay: they act on the way into a gear only."""

from __future__ import annotations

import abc
from typing import Annotated, NamedTuple

from can_dbc.messages import Chamber, Gear
from controller.position import Estimate
from controller.settings import Settings, bounded, nanoseconds
from controller.strategies import Duties, ShiftContext, Strategy, one_chamber


class Command(NamedTuple):
    """Whether to fill the charged chamber, and the neutral one that brakes."""

    charge: bool
    brake: bool


class PushProgress(NamedTuple):
    """Late measurements of a push, from neutral towards the gear.

    spent_s: since it began; new_samples: since the last step; apart_rad_s: distance of the speeds as last reported,
    None without a valid report; apart_s: when the step that received it first was, since the push began (negative:
    before).
    """

    spent_s: float
    travelled_m: float
    speed_m_s: float
    new_samples: int
    apart_rad_s: float | None = None
    apart_s: float = 0.0


PUSH = Command(True, False)
BRAKE = Command(False, True)
REST = Command(False, False)


class IntoGearParameters(Settings, frozen=True):
    """Settings that every braking strategy has."""

    patience_s: Annotated[float, bounded(0.02, 1.0, "s")] = 0.35
    """A push that has lasted so long goes on in open loop: a hard synchronization has used up the
    time, and a stay held short of its gear would never be confirmed."""


def within(begun_s: float | None, now_s: float, length_s: float) -> bool:
    """Whether something that may have begun at a step goes on now.

    A length of N periods is N steps long whenever it begins: instants are a nanosecond apart, rounding loses far less.
    """
    return begun_s is not None and now_s - begun_s < length_s - 0.5e-9


class IntoGear(Strategy):
    """A push into gear with a brake: the neutral chamber, which the motion compresses.

    To neutral, in a repeated attempt and after `patience_s` it is today's open loop (thesis 4.2.1). Only the charged
    chamber and the neutral one are ever filled, so backward and forward never meet.
    """

    parameters: IntoGearParameters

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the duties that `decide` chooses, or the open loop's."""
        spent_ns = now_ns - shift.start_ns
        impatient = spent_ns >= nanoseconds(self.parameters.patience_s)
        if shift.leg is Gear.NEUTRAL or shift.attempt > 0 or impatient:
            return one_chamber(shift.charged, self.config.duty)
        towards = 1.0 if shift.leg is Gear.BACKWARD else -1.0
        command = self.decide(
            PushProgress(
                spent_s=spent_ns * 1e-9,
                travelled_m=towards * estimate.position_m,
                speed_m_s=towards * estimate.velocity_m_s,
                new_samples=len(estimate.samples),
                apart_rad_s=None if shift.apart_rad_s is None else abs(shift.apart_rad_s),
                apart_s=(shift.apart_ns - shift.start_ns) * 1e-9,
            )
        )
        charged = self.config.duty if command.charge else 0.0
        return Duties(
            charged if shift.charged is Chamber.B else 0.0,
            self.config.duty if command.brake else 0.0,
            charged if shift.charged is Chamber.F else 0.0,
        )

    @abc.abstractmethod
    def decide(self, progress: PushProgress) -> Command:
        """Choose the valves for the coming period."""
