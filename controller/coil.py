"""The current of a valve's coil, by which a filling ends when it should.

A valve closes when the current of its coil has decayed to the holding level: 35 ms after a long full
duty, sooner after a short or a reduced one (thesis 3.1.3). So the end of a filling, unlike its
beginning, is not bound to the steps of the firmware: the duties of its last steps decide it.
"""

from __future__ import annotations

from math import exp, log

SETTLED, HOLDING = 0.98, 0.34
"""Duty after which the closing delay is stated, and the current at which the plunger lets go, by that
of a duty of 1: halfway between 33 and 35 % (thesis 3.1.3)."""
DECAY = 0.0293 / 0.035
"""Time constant of the current by that closing delay (inferred)."""
PLUNGER = 1.0 - DECAY * log(SETTLED / HOLDING)
"""The rest of the delay, the plunger's, by the whole of it."""
LEAST, KEPT = 0.37, (0.5, 0.75, 0.42)
"""Least duty of the last step of a filling, above the 35 % that hold a valve open (thesis 3.1.3), and those
between the first and the last one: the first of them with which the last one can be met."""


class Coil:
    """Follow the commands of one valve, and choose those that let it close at a time.

    Assumes that the current follows the duty with one time constant; opening is not delayed by a
    reduced duty, since the first step of a filling has the full one.
    """

    def __init__(self, period_s: float, close_s: float) -> None:
        """Take the closing delay after a long full duty, s, at the present temperature."""
        self.current = 0.0
        self._period_s = period_s
        self._tau_s = DECAY * close_s
        self._plunger_s = PLUNGER * close_s
        self._stays = exp(-period_s / self._tau_s)
        self._given = 1.0 / (1.0 - self._stays)

    def step(self, duty: float) -> None:
        """Take the duty of the coming period."""
        self.current = self._after(duty)

    def closes_s(self) -> float:
        """Return how long after its command ends the valve closes."""
        return self._plunger_s + self._decay_s(self.current)

    def duty_until(self, rest_s: float, full: float) -> float:
        """Return the duty of the coming period for a valve that is to close in `rest_s`; 0 to end now.

        What no duties can reach is ended as near to it as they can.
        """
        early_s = rest_s - self.closes_s()
        if early_s <= 0.0:
            return 0.0
        decays_s = rest_s - self._period_s - self._plunger_s
        duty = self._last(self.current, decays_s)
        if duty > full:
            next_s = decays_s - self._period_s
            for kept in KEPT:
                current = self._after(kept)
                last = self._last(current, next_s)
                if LEAST <= last <= full and next_s >= 0.0:
                    return kept
            if last > full:
                return KEPT[0]
            # too long for one more step, too short for two
            late_s = self._decay_s(LEAST + (current - LEAST) * self._stays) - next_s
            return full if decays_s - self._decay_s(self._after(full)) < late_s else KEPT[-1]
        if duty >= LEAST and decays_s >= 0.0:
            return duty
        late_s = self._decay_s(self._after(LEAST)) - decays_s
        return LEAST if late_s < early_s else 0.0

    def _after(self, duty: float) -> float:
        """Return the current after a period at a duty."""
        return duty + (self.current - duty) * self._stays

    def _decay_s(self, current: float) -> float:
        """Return how long a current decays until the plunger lets go."""
        return self._tau_s * log(current / HOLDING) if current > HOLDING else 0.0

    def _last(self, current: float, decays_s: float) -> float:
        """Return the duty after a period of which a current decays for so long."""
        needed = HOLDING * exp(min(decays_s / self._tau_s, 3.0))
        return current + (needed - current) * self._given
