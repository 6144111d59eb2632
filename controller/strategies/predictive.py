"""Model predictive control: try a small set of valve sequences, take the best one's first step."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from msgspec import Struct

from controller.settings import ControlConfig, bounded
from controller.strategies.foresight import Foresight, ForesightParameters
from controller.strategies.into_gear import Command


class CommandTimes(NamedTuple):
    """Commands by their delays from now, s."""

    brake_on_s: float
    brake_off_s: float
    charge_off_s: float
    charge_on_s: float


def sequences(period_s: float) -> tuple[CommandTimes, ...]:
    """Return the 27 sequences that are tried: a burst now or later, with or without charge."""
    never = math.inf
    sequences = [CommandTimes(never, never, never, never)]
    for delay in (0, 1, 2, 3):
        for length in (1, 2, 4):
            on_s, off_s = delay * period_s, (delay + length) * period_s
            sequences.append(CommandTimes(on_s, off_s, never, never))
            sequences.append(CommandTimes(on_s, off_s, on_s, off_s))
    sequences += [CommandTimes(never, never, 0.0, length * period_s) for length in (1, 2)]
    return tuple(sequences)


class PredictiveParameters(ForesightParameters, frozen=True):
    """Weights of the cost."""

    time_weight_m_s2: Annotated[float, bounded(0.0, 1000.0, "m/s2")] = 10.0
    way_weight_per_s: Annotated[float, bounded(0.0, 1e5, "1/s")] = 300.0


class Predictive(Foresight):
    """Take the first step of the sequence with the lowest cost in the light model (thesis 4.2.2).

    Cost = impact speed + time_weight * time + way_weight * way left at the horizon. At most
    27 * horizon/0.5 ms model steps of some 75 operations: 250,000 a step at a horizon of 60 ms.
    """

    Parameters = PredictiveParameters
    parameters: PredictiveParameters

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        super().__init__(config, parameters)
        self._sequences = sequences(config.period_s)

    def plan(self, spent_s: float) -> Command:
        """Try every sequence; of equals the first, which does least, wins."""
        best, least = self._sequences[0], float("inf")
        weights = self.parameters
        for sequence in self._sequences:
            outcome = self.trial(*sequence)
            late = weights.time_weight_m_s2 * outcome.time_s
            cost = outcome.speed_m_s + late + weights.way_weight_per_s * outcome.left_m
            if cost < least:
                best, least = sequence, cost
        return Command(best.charge_off_s > 0.0, best.brake_on_s <= 0.0)
