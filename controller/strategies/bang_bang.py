"""Time-optimal bang-bang: full push, then full brake, switched once at the last good moment."""

from __future__ import annotations

from typing import Annotated

from can_dbc.errors import InputError
from controller.settings import bounded
from controller.strategies.foresight import Foresight, ForesightParameters
from controller.strategies.into_gear import Command, PushProgress, within

Table = tuple[tuple[float, float], ...]


def stored_s(table: Table, supply_pa: float) -> float:
    """Return the stored switching time of a supply pressure; straight lines between the entries."""
    before_pa, before_s = table[0]
    if supply_pa <= before_pa:
        return before_s
    for pressure_pa, switch_s in table[1:]:
        if supply_pa <= pressure_pa:
            share = (supply_pa - before_pa) / (pressure_pa - before_pa)
            return before_s + share * (switch_s - before_s)
        before_pa, before_s = pressure_pa, switch_s
    return before_s


class BangBangParameters(ForesightParameters, frozen=True):
    """What is stored, what arrival is soft enough, and what counts as motion."""

    table: Table = ((6e5, 0.002), (7e5, 0.004), (8e5, 0.002), (9e5, 0.002))
    """Supply pressure, Pa, ascending, and time from the push to the brake command, s. Computed
    off line for the laboratory's length stroke, today's valves and 20 ms of braking."""
    impact_m_s: Annotated[float, bounded(0.0, 3.0, "m/s")] = 0.2
    brake_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.02
    """Time for which the neutral chamber is filled and the driving one is not."""
    seen_m: Annotated[float, bounded(0.0, 0.01, "m")] = 0.0005
    """Measured travel that counts as motion."""

    def __post_init__(self) -> None:
        super().__post_init__()
        pressures = [pressure_pa for pressure_pa, _ in self.table]
        if not pressures or pressures != sorted(set(pressures)):
            raise InputError("table: wrong order; expected ascending supply pressures")


class BangBang(Foresight):
    """Push, and brake as late as the light model says is early enough (thesis 4.1, 4.2.1).

    By Pontryagin the quickest soft arrival is a matter of switching times. Until motion is measured the stored time
    counts; then it is solved anew in every step, by bisection on the impact speed: at most 8 trials of horizon/0.5 ms
    model steps of some 60 operations, 60,000 a step at a horizon of 60 ms.
    """

    Parameters = BangBangParameters
    parameters: BangBangParameters

    _moved = False
    _begun_s: float | None = None

    def reset(self) -> None:
        """Forget the motion and the brake."""
        super().reset()
        self._moved = False
        self._begun_s = None

    def decide(self, progress: PushProgress) -> Command:
        """Note whether motion has been measured, then plan."""
        self._moved = self._moved or progress.travelled_m >= self.parameters.seen_m
        return super().decide(progress)

    def plan(self, spent_s: float) -> Command:
        """Push until the switching time is nearer than half a period, then brake for its time."""
        parameters = self.parameters
        if self._begun_s is None:
            waiting_s = stored_s(parameters.table, parameters.model.supply_pa) - spent_s
            ahead_s = self._solved_s() if self._moved else waiting_s
            if ahead_s < 0.5 * self.config.period_s:
                self._begun_s = spent_s
        braking = within(self._begun_s, spent_s, parameters.brake_s)
        return Command(not braking, braking)

    def _solved_s(self) -> float:
        """Return how long from now the brake may wait for the wanted impact speed."""
        parameters = self.parameters
        early_s, late_s = 0.0, parameters.horizon_s
        if self._speed_m_s(early_s) >= parameters.impact_m_s:
            return early_s
        if self._speed_m_s(late_s) <= parameters.impact_m_s:
            return late_s
        for _ in range(6):
            middle_s = 0.5 * (early_s + late_s)
            if self._speed_m_s(middle_s) > parameters.impact_m_s:
                late_s = middle_s
            else:
                early_s = middle_s
        return early_s

    def _speed_m_s(self, brake_on_s: float) -> float:
        off_s = brake_on_s + self.parameters.brake_s
        return self.trial(brake_on_s, off_s, brake_on_s, off_s).speed_m_s
