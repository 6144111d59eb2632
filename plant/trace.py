"""Trace rows: true states at regular instants, and signals that hold between their changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.devices.valve import Drive
from plant.parts.damper import steady_oil_pressure
from plant.systems.length_stroke import LengthStroke

Floats = NDArray[np.float64]
Update = tuple[int, int, float]
"""Instant in ns, column among the signals and currents, value from then on."""

STATES = (
    *("position_m", "velocity_m_s", "piston_1_m", "piston_2_m"),
    *(f"pressure_{chamber}_pa" for chamber in ("B", "N", "F", "oil2")),
    "spent_impulse_n_s",
)
TRACE_COLUMNS = (
    *("time_s", *STATES),
    *(f"cmd_{chamber}" for chamber in "BNF"),
    *(f"valve_{chamber}" for chamber in "BNF"),
    *("pulse_s", "input_rad_s", "output_rad_s"),
)
"""Columns of a trace row: time, true states, and signals that hold between their changes: duty at
the coil, actual valve position, duration in the latest pulse report (0 before the first), and shaft
speeds as last published. A row shows what has changed at its very instant."""

CMD, VALVE, PULSE, SPEEDS, CURRENT = 0, 3, 6, 7, 9
"""Where each group begins among the signals and currents."""


def trace_columns(drive: Drive) -> tuple[str, ...]:
    """Return the columns of a trace row; with coils also their currents."""
    currents = tuple(f"current_{chamber}_a" for chamber in "BNF") if drive == "coil" else ()
    return TRACE_COLUMNS + currents


class TraceSink(Protocol):
    """Receiver of the trace rows during the run."""

    def write(self, rows: Floats) -> None:
        """Take rows [n, number of columns] in the units of the columns' names."""


class TraceRows:
    """Make the rows at 0, period_ns, 2 period_ns, ... and pass them to a sink."""

    def __init__(
        self,
        stroke: LengthStroke,
        damper: str,
        sink: TraceSink | None,
        period_ns: int,
        at_once: int = 1,
        drive: Drive = "delays",
    ) -> None:
        """`damper` and `drive` as in `PlantConfig`; no rows without a sink or with period_ns 0.

        `at_once`: the sink gets rows when there are so many, and at `flush`.
        """
        self._stroke = stroke
        self._oil_follows_motion = damper == "incompressible"
        self._sink = sink if period_ns else None
        self._period_ns = period_ns
        self._next_ns = 0
        self._columns = [stroke.columns.index(name) for name in STATES]
        self._at_once = at_once
        self._width = len(trace_columns(drive))
        self._latest = [0.0] * (self._width - 1 - len(STATES))
        self._states: list[Floats] = []
        self._updates: list[Update] = []
        self._written_ns = 0  # the first row that the sink has not got

    def instants_ns(self, until_ns: int) -> range:
        """Instants of the rows up to `until_ns` that have not been written yet."""
        if self._sink is None:
            return range(0)
        return range(self._next_ns, until_ns + 1, self._period_ns)

    def write(self, instants: range, states: Sequence[Floats], updates: Sequence[Update]) -> None:
        """Write the rows at `instants` from blocks of states [n, all columns], and changes of the signals, in order."""
        if self._sink is None:
            return
        self._updates += updates
        if instants:
            self._states += states
            self._next_ns += self._period_ns * len(instants)
            if self._next_ns - self._written_ns >= self._at_once * self._period_ns:
                self.flush()

    def flush(self) -> None:
        """Hand over the rows that are there."""
        if self._sink is None or self._next_ns == self._written_ns:
            return
        instants = np.arange(self._written_ns, self._next_ns, self._period_ns, dtype=np.int64)
        states = np.concatenate(self._states)
        rows = np.empty((len(instants), self._width))
        rows[:, 0] = instants / NS_PER_S
        first_signal = 1 + len(STATES)
        rows[:, 1:first_signal] = states[:, self._columns]
        if self._oil_follows_motion:
            rows[:, 1 + STATES.index("pressure_oil2_pa")] = self._oil_pressure_pa(states)
        changes: list[list[tuple[int, float]]] = [[(0, value)] for value in self._latest]
        first, period = self._written_ns, self._period_ns
        for instant, column, value in self._updates:
            changes[column].append((max(0, -((first - instant) // period)), value))
            self._latest[column] = value
        for column, steps in enumerate(changes, first_signal):
            if len(steps) == 1:
                rows[:, column] = steps[0][1]
                continue
            begins, values = zip(*steps, strict=True)
            lasting = np.diff(np.minimum((*begins, len(rows)), len(rows)))
            rows[:, column] = np.repeat(values, lasting)
        self._states.clear()
        self._updates.clear()
        self._written_ns = self._next_ns
        self._sink.write(rows)

    def _oil_pressure_pa(self, states: Floats) -> Floats:
        """Oil pressure where it is no state but follows from the motion [n]."""
        oil = np.empty(len(states))
        position, velocity = np.ascontiguousarray(states[:, :2].T)
        steady_oil_pressure(position, velocity, self._stroke.packed.array, oil)
        return oil
