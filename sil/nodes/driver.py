"""The driver, or the control unit that acts for one: requests gears on a schedule."""

from __future__ import annotations

from collections.abc import Sequence

from can_dbc.e2e import Protector
from can_dbc.frame import Frame
from can_dbc.messages import Gear, ShiftRequest
from sil.coupling.clock import next_tick


class DriverNode:
    """Sends a protected ShiftRequest every period; the gear it carries follows a schedule.

    A request is sent with the first frame at or after its instant.
    """

    name = "driver"

    def __init__(
        self, initial: Gear, schedule: Sequence[tuple[int, Gear]], period_ns: int, phase_ns: int = 0
    ) -> None:
        """`schedule`: instants in ns, ascending, and the gear requested from then on."""
        self._gear = initial
        self._schedule = list(schedule)
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        self._protector = Protector(ShiftRequest)

    def start(self) -> int:
        """Return the instant of the first frame, ns."""
        return self._phase_ns

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Send the frame that is due at `until_ns`; frames of others are ignored."""
        while self._schedule and self._schedule[0][0] <= until_ns:
            self._gear = self._schedule.pop(0)[1]
        following = next_tick(until_ns, self._period_ns, self._phase_ns)
        is_due = until_ns >= self._phase_ns and following - until_ns == self._period_ns
        frame = self._protector.protect(ShiftRequest(self._gear)) if is_due else None
        return ([(until_ns, frame)] if frame is not None else []), following

    def close(self) -> None:
        """Do nothing: the node holds no resources."""
