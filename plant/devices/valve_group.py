"""The valves of the chambers B, N and F together: duties in, moves of the plungers out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from plant.devices.coil import CoilValve
from plant.devices.valve import Valve
from plant.devices.valve_driver import Duties
from plant.devices.valve_faults import ValveFault, faulty_valves

Switch = tuple[int, int, float]  # instant in ns, chamber, 1 on or open, 0 off or closed


class ValveGroup:
    """Valves, those with faults behind them; chambers are numbered in the order of the names."""

    def __init__(
        self, valves: Sequence[Valve], names: Sequence[str], faults: Sequence[ValveFault], seed: int
    ) -> None:
        """Combine valves and their faults. Raises InputError for faults that `FaultyValve` refuses."""
        self.valves = tuple(valves)
        self._faulty = faulty_valves(valves, names, faults, seed)

    def drive(
        self, until_ns: int, commands: Sequence[tuple[int, Duties]]
    ) -> tuple[list[Switch], list[Switch]]:
        """Apply the driver's duties; return the switches of the coils and the plungers' moves, by time, then chamber."""
        coils: list[Switch] = []
        for instant, duties in commands:
            for chamber, duty in enumerate(duties):
                if chamber in self._faulty:
                    self._faulty[chamber].hand_over(instant, duty)
                else:
                    self._command(instant, chamber, duty, coils)
        for chamber, faulty in self._faulty.items():
            for instant, duty in faulty.until(until_ns):
                self._command(instant, chamber, duty, coils)
        moves = [
            (instant, chamber, u)
            for chamber, valve in enumerate(self.valves)
            for instant, u in valve.moves(until_ns)
        ]
        if len(moves) > 1:
            moves.sort()
        return coils, moves

    def currents(self) -> Iterator[tuple[int, int, float]]:
        """Yield (instant in ns, chamber, current in A) since the last call, each chamber's in order."""
        for chamber, valve in enumerate(self.valves):
            if isinstance(valve, CoilValve):
                yield from ((at, chamber, amps) for at, amps in valve.currents)
                valve.currents.clear()

    def _command(self, now_ns: int, chamber: int, duty: float, coils: list[Switch]) -> None:
        valve = self.valves[chamber]
        before = valve.is_energised
        valve.command(now_ns, duty)
        if valve.is_energised != before:
            coils.append((now_ns, chamber, float(valve.is_energised)))
