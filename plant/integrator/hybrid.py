"""A hybrid system in motion: state, modes, valves and the kernel's call, events by name, balances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.equations.volumes import emptied, refuse_empty, volumes_m3
from plant.errors import IntegrationError, NoVolumeError
from plant.integrator.filling import NO_CURVES
from plant.integrator.integrate import advance
from plant.integrator.loop import DONE, NOT_FINITE, STEP_TOO_SMALL, TOO_MANY_EVENTS, Control, Run
from plant.kernel import layout, packing

DEFAULT_TOLERANCE = 1e-8
NO_GRID = np.zeros((1, layout.GridRow.size))

REASONS = {
    TOO_MANY_EVENTS: "too many events",
    STEP_TOO_SMALL: "the step became too small",
    NOT_FINITE: "the state is not finite",
}


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened at an instant inside the motion.

    name: "stop" (stay against an end, or neutral), "block", "unblock", "breakaway", contacts and turns; energy_j:
    turned to heat.
    """

    time_s: float
    name: str
    position_m: float
    speed_m_s: float
    energy_j: float


@dataclass(frozen=True, slots=True)
class Balance:
    """What must not get lost, as residuals of the integrated quantities.

    energy_residual_j: change of kinetic energy less work of gas, loads, friction, damper, impacts, against the gas's
    energy_scale_j; gas_residual_j: per chamber, change of PV less the integrals of alpha_m R epsilon and (1 - alpha) P
    dV; air_in_kg, air_out_kg: through the valves, at the temperature of the model.
    """

    energy_residual_j: float
    energy_scale_j: float
    gas_residual_j: tuple[float, ...]
    gas_scale_j: float
    air_in_kg: float
    air_out_kg: float
    friction_j: float
    damper_j: float
    impact_j: float

    @property
    def closed(self) -> bool:
        """True if the residuals are within 1e-6 of the exchanged energy: integration error alone."""
        mechanical = abs(self.energy_residual_j) <= 1e-6 * max(self.energy_scale_j, 1.0)
        gas = max((abs(r) for r in self.gas_residual_j), default=0.0)
        return mechanical and gas <= 1e-6 * max(self.gas_scale_j, 1.0)


class HybridSystem:
    """State, modes and valves of one actuator, advanced in simulated time."""

    chambers: tuple[str, ...]

    def __init__(
        self,
        system: int,
        p: layout.Parameters,
        c: packing.Floats,
        y: packing.Floats,
        load: packing.Load,
        charged: Sequence[str],
        tolerance: float,
        *,
        has_line: bool = False,
    ) -> None:
        refuse_empty(system, p, [y])
        self._system = system
        self._p, self._c = p, c
        self._run, self._control = Run.zeros(), Control.zeros(np.int64)
        self._run.array[: len(y)] = y
        self._control.modes = packing.fresh_modes(system, load).array
        layout.Modes(self._control.modes).masses = 1 if p.air_kappa > 0.0 else 0
        self._y = self._run.array[: len(y)]
        self._state: Any = packing.state_record(system)(self._y)
        self._m = layout.Modes(self._control.modes)
        self._n = self._state.size if self._m.masses else packing.STATE_COUNTS[system][2]
        # stick-slip between closed chambers makes hundreds of events in a quarter second;
        # a view, as all that is no state
        self._record = np.zeros((2000, layout.EventRow.size))[:]
        self._m.line = 1 if has_line else 0
        run, control = self._run, self._control
        run.tolerance = tolerance
        run.scale[: self._state.size] = packing.scales(system)
        for index, name in enumerate(self.chambers):
            run.u0[index] = 1.0 if name in charged else 0.0
        run.wanted = packing.FIRST_STEP_S
        control.states = self._n
        control.quadratures = layout.Quadratures.size
        self._impact_j = 0.0
        self.now_ns = 0
        self.events: list[Event] = []
        self._choose_modes()
        self._pv0 = self._pv()
        self._kinetic0 = self._kinetic()

    # --- state ------------------------------------------------------------------------------
    @property
    def position_m(self) -> float:
        """Stay (or fixed piston) position [m]."""
        return float(self._y[0])

    @property
    def velocity_m_s(self) -> float:
        """Stay (or fixed piston) velocity [m/s]."""
        return float(self._y[1])

    @property
    def pressures_pa(self) -> tuple[float, ...]:
        """Pressures of the chambers, in their order, absolute [Pa]."""
        return tuple(self._y[layout.pressure_slice(self._system)].tolist())

    @property
    def packed(self) -> layout.Parameters:
        """A copy of the parameters."""
        return self._p.copy()

    def _choose_modes(self) -> None:
        self._control.starting = 1
        self.advance(self.now_ns)

    # --- motion -----------------------------------------------------------------------------
    def advance(
        self,
        until_ns: int,
        switches: Sequence[tuple[int, int, float] | tuple[int, int, float, float]] = (),
        sample_ns: NDArray[np.int64] | None = None,
    ) -> packing.Floats:
        """Integrate to `until_ns`; returns the states [n, states] in SI units at `sample_ns` [n], ascending.

        switches: (instant ns, chamber index, position 0 to 1, slope 1/s if it moves on), ascending; one at `until`
        acts from there on. Raises IntegrationError if the motion cannot be continued (not finite, endless events),
        ValueError for instants out of order or outside [now, until].
        """
        if until_ns < self.now_ns:
            raise ValueError(f"cannot advance back from {self.now_ns} ns to {until_ns} ns")
        rows = np.zeros((len(switches), 4))
        last = self.now_ns
        for k, (instant, chamber, position, *slope) in enumerate(switches):
            if not last <= instant <= until_ns:
                raise ValueError(f"switch at {instant} ns is out of order or out of the interval")
            last = instant
            since_s = (instant - self.now_ns) / NS_PER_S
            rows[k] = since_s, chamber, position, slope[0] if slope else 0.0
        samples = np.zeros(0) if sample_ns is None else (sample_ns - self.now_ns) / NS_PER_S
        out = np.zeros((samples.shape[0], self._n))
        self._control.events = 0
        self._run.end = (until_ns - self.now_ns) / NS_PER_S
        code = advance(
            self._run.array, self._control.array, self._p.array, self._c, rows, samples, out,
            self._record, NO_CURVES, NO_GRID,
        )  # fmt: skip
        self._control.starting = 0
        self._note_events()
        if code != DONE:
            stopped_s = self.now_ns / NS_PER_S + float(self._run.time)
            message = f"integration stopped after {stopped_s:.6f} s: {REASONS[code]}"
            shut = emptied(self._system, self._p, [self._y], share=0.01)
            if shut:
                raise NoVolumeError(f"{shut} ({message})")
            raise IntegrationError(message)
        self.now_ns = until_ns
        return out

    def _note_events(self) -> None:
        for row in map(layout.EventRow, self._record[: self._control.events]):
            name = layout.Guard(int(row.guard)).event
            speed = float(row.speed)
            if row.at_block == 1.0:
                name = "block"
            elif speed > 0.0:
                name = "stop"
            self._impact_j += float(row.lost)
            time_s = self.now_ns / NS_PER_S + float(row.time)
            self.events.append(Event(time_s, name, float(row.x), speed, float(row.lost)))

    # --- balances -----------------------------------------------------------------------------
    def _pv(self) -> list[float]:
        volumes = volumes_m3(self._system, self._p, self._y)
        return [p * v for p, v in zip(self.pressures_pa, volumes, strict=True)]

    def _kinetic(self) -> float:
        p, y = self._p, self._y
        energy = 0.5 * p.m_s * y[1] ** 2
        if self._system == layout.LENGTH:
            energy += 0.5 * p.m_p * (self._state.v_1**2 + self._state.v_2**2)
        return float(energy)

    def balance(self) -> Balance:
        """Energy and gas balances since the start."""
        q = layout.Quadratures(self._y[self._n :])
        works = [float(work) for work in q.work]
        work = sum(works)
        residual = (
            self._kinetic()
            - self._kinetic0
            - work
            - q.external
            - q.atmosphere
            + q.friction
            + q.damper
            + self._impact_j
        )
        gas = tuple(
            float(pv - pv0 - q.gas[k] - q.heat[k])
            for k, (pv, pv0) in enumerate(zip(self._pv(), self._pv0, strict=True))
        )
        return Balance(
            float(residual),
            sum(abs(w) for w in works),
            gas,
            float(sum(abs(q.gas[k]) + abs(q.heat[k]) for k in range(3))),
            float(sum(q.mass_in)),
            float(sum(q.mass_out)),
            float(q.friction),
            float(q.damper),
            self._impact_j,
        )
