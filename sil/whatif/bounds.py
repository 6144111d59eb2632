"""What no controller can beat: the softest arrival that any valve sequence can reach.

Clairvoyant: everything is known in advance, and the commands of the driving and of the neutral
valve may change at any instant. The search is over the instants of at most six changes, on the
plant's own equations: first a coarse grid over every pattern, then the best of each refined.
Non-anticipating: a load shows only in the motion it makes different, and an action that depends on
it comes no sooner than that plus the information delay; before that all loads share their commands.
What a search finds is what a sequence reaches: an upper estimate of the bound, which the refinement
can only lower. Checked by tests/unit/sil/test_bounds.py.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from can_dbc.errors import RunError
from plant.hybrid import IntegrationError
from plant.parameters import ParameterSet
from plant.stroke import simulate
from plant.stroke_conditions import FULL_DUTY, StrokeConditions

MOST_SWITCHES = 6
NEVER_M_S = math.inf


@dataclass(frozen=True)
class LoadCase:
    """What a shift from neutral to backward meets."""

    name: str
    supply_pressure_pa: float = 900000.0
    mounted: bool = False
    mesh_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0


LOADS = (
    LoadCase("lab, 9 bar"),
    LoadCase("lab, 6 bar", supply_pressure_pa=600000.0),
    LoadCase("truck, easy", mounted=True, mesh_force_n=500.0, sync_impulse_n_s=18.0),
    LoadCase("truck, typical", mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=78.0),
    LoadCase("truck, 2.2 kN", mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=250.0),
)
"""The load cases of the shipped studies."""


@dataclass(frozen=True)
class Commands:
    """Instants at which the two commands change, s: the driving valve from on, neutral from off."""

    driving_s: tuple[float, ...] = ()
    braking_s: tuple[float, ...] = ()

    @property
    def switches(self) -> int:
        """Number of changes."""
        return len(self.driving_s) + len(self.braking_s)

    def rows(self) -> tuple[tuple[float, str, float], ...]:
        """The commands as a stroke takes them; driving is on from time 0."""
        rows = [(0.0, "B", FULL_DUTY)]
        for k, at_s in enumerate(self.driving_s):
            rows.append((at_s, "B", FULL_DUTY if k % 2 else 0.0))
        for k, at_s in enumerate(self.braking_s):
            rows.append((at_s, "N", 0.0 if k % 2 else FULL_DUTY))
        return tuple(sorted(rows, key=lambda row: row[0]))

    def until(self, time_s: float) -> Commands:
        """The changes up to a time."""
        return Commands(
            tuple(t for t in self.driving_s if t <= time_s),
            tuple(t for t in self.braking_s if t <= time_s),
        )


@dataclass(frozen=True)
class Arrival:
    """How a sequence ends: impact speed and time from the first command; inf when it never does."""

    speed_m_s: float
    time_s: float


NEVER = Arrival(NEVER_M_S, math.inf)


@dataclass
class Shooter:
    """Arrivals of command sequences under one load, on the plant's equations.

    until_s: an arrival later than this is none. `runs` counts the simulations made.
    """

    parameters: ParameterSet
    case: LoadCase
    until_s: float
    runs: int = 0

    def conditions(self, commands: Commands) -> StrokeConditions:
        """The stroke that a sequence makes."""
        case = self.case
        return StrokeConditions(
            "N-B",
            case.supply_pressure_pa,
            commands.rows(),
            mounted=case.mounted,
            mesh_force_n=case.mesh_force_n,
            sync_impulse_n_s=case.sync_impulse_n_s,
        )

    def arrival(self, commands: Commands) -> Arrival:
        """Simulate a sequence up to its first impact on the gear's stop."""
        self.runs += 1
        times = np.array([0.0, self.until_s])
        try:
            stroke = simulate(self.parameters, self.conditions(commands), times, internal=False)
        except IntegrationError:
            return NEVER
        impact = stroke.impact
        if impact is None or impact.position_m < 0.5 * self.parameters.value("length.stroke"):
            return NEVER
        return Arrival(float(impact.speed_m_s), float(impact.time_s))

    def first_motion_s(self, commands: Commands, seen_m: float = 5e-5) -> float:
        """When the stay has left neutral by `seen_m`; inf if it never does."""
        times = np.arange(round(self.until_s / 1e-4) + 1, dtype=np.float64) * 1e-4
        stroke = simulate(self.parameters, self.conditions(commands), times, internal=False)
        moved = np.flatnonzero(np.abs(stroke.position_m) > seen_m)
        return float(times[moved[0]]) if len(moved) else math.inf


def patterns(most_switches: int = MOST_SWITCHES) -> Iterator[tuple[int, int]]:
    """Numbers of changes of (driving, neutral), up to `most_switches` together."""
    for total in range(most_switches + 1):
        for driving in range(total + 1):
            yield driving, total - driving


def coarse(
    pattern: tuple[int, int], begin_s: float, end_s: float, budget: int, rng: np.random.Generator
) -> Iterator[Commands]:
    """Starting sequences of a pattern: its whole grid when the budget allows, else random ones."""
    driving, braking = pattern
    dimension = driving + braking
    if dimension == 0:
        yield Commands()
        return
    levels = 1
    while math.comb(levels + 1, driving) * math.comb(levels + 1, braking) <= budget:
        levels += 1
    if levels >= 8:
        grid = np.linspace(begin_s, end_s, levels)
        for first in itertools.combinations(grid, driving):
            for second in itertools.combinations(grid, braking):
                yield Commands(tuple(map(float, first)), tuple(map(float, second)))
        return
    for _ in range(budget):
        draws = begin_s + (end_s - begin_s) * rng.random(dimension)
        yield Commands(
            tuple(sorted(float(t) for t in draws[:driving])),
            tuple(sorted(float(t) for t in draws[driving:])),
        )


@dataclass(frozen=True)
class Best:
    """The best sequence found: its arrival, and the simulations spent."""

    commands: Commands
    arrival: Arrival
    runs: int


def refine(shooter: Shooter, start: Best, begin_s: float, step_s: float, least_s: float) -> Best:
    """Move one instant at a time, halving the step: no result is worse than the start."""
    best = start
    while step_s >= least_s:
        better = False
        for which, k, sign in [
            (w, k, s)
            for w in ("driving_s", "braking_s")
            for k in range(len(getattr(best.commands, w)))
            for s in (1.0, -1.0)
        ]:
            times = list(getattr(best.commands, which))
            times[k] += sign * step_s
            if times != sorted(times) or times[0] < begin_s:
                continue
            moved = replace(best.commands, **{which: tuple(times)})
            arrival = shooter.arrival(moved)
            if arrival.speed_m_s < best.arrival.speed_m_s:
                best, better = Best(moved, arrival, shooter.runs), True
        if not better:
            step_s *= 0.5
    return best


def clairvoyant(
    parameters: ParameterSet,
    case: LoadCase,
    within_s: float,
    *,
    most_switches: int = MOST_SWITCHES,
    budget: int = 150,
    refined: int = 3,
    seed: int = 0,
    given: Commands = Commands(),
    from_s: float = 0.0,
) -> Best:
    """Softest arrival within a time of the first command, everything known.

    budget: coarse sequences a pattern; refined: how many of the best patterns are refined. `given`
    fixes the changes up to `from_s`; only later ones are searched for.
    """
    shooter = Shooter(parameters, case, within_s)
    rng = np.random.default_rng([seed, most_switches])
    fixed = given.until(from_s)
    found: list[Best] = []
    for pattern in patterns(most_switches - fixed.switches):
        best = Best(fixed, NEVER, 0)
        for tail in coarse(pattern, from_s, within_s, budget, rng):
            commands = Commands(fixed.driving_s + tail.driving_s, fixed.braking_s + tail.braking_s)
            arrival = shooter.arrival(commands)
            if arrival.speed_m_s < best.arrival.speed_m_s or best.runs == 0:
                best = Best(commands, arrival, shooter.runs)
        found.append(best)
    found.sort(key=lambda best: best.arrival.speed_m_s)
    coarse_step_s = 0.1 * (within_s - from_s)
    refinements = [refine(shooter, b, from_s, coarse_step_s, 1e-4) for b in found[:refined]]
    winner = min([*refinements, *found], key=lambda best: best.arrival.speed_m_s)
    return replace(winner, runs=shooter.runs)


@dataclass(frozen=True)
class Shared:
    """Best worst case when all loads share their commands up to `revealed_s`."""

    revealed_s: float
    prefix: Commands
    worst_m_s: float
    per_load: tuple[Best, ...]


def prefixes(until_s: float, levels: int) -> Iterator[Commands]:
    """Shared beginnings: up to two changes of each valve on a grid of instants."""
    grid = [float(t) for t in np.linspace(0.0, until_s, levels)]
    one = [(), *((t,) for t in grid), *itertools.combinations(grid, 2)]
    for driving, braking in itertools.product(one, one):
        if len(driving) + len(braking) <= 2:
            yield Commands(driving, braking)


def non_anticipating(
    parameters: ParameterSet,
    cases: Sequence[LoadCase],
    delay_s: float,
    extra_s: float,
    *,
    levels: int = 4,
    budget: int = 30,
    most_switches: int = 4,
    seed: int = 0,
) -> Shared:
    """Best worst-case impact over loads that show only `delay_s` after the earliest motion.

    Before that no load can be told from another, so their commands are the same; after it each load
    counts as known altogether, which is more than any controller learns. Shared beginnings are those
    of a grid and those of each load's own best sequence. The earliest motion is
    that of the full push, which nothing can bring forward. Each load must arrive within its open
    loop's time plus `extra_s`.
    """
    spans = []
    earliest_s = math.inf
    for case in cases:
        open_loop = Shooter(parameters, case, 1.0)
        spans.append(open_loop.arrival(Commands()).time_s + extra_s)
        earliest_s = min(earliest_s, Shooter(parameters, case, 0.1).first_motion_s(Commands()))
    revealed_s = earliest_s + delay_s
    beginnings = list(prefixes(min(revealed_s, max(spans)), levels))
    for case, span_s in zip(cases, spans, strict=True):
        alone = clairvoyant(
            parameters, case, span_s, most_switches=most_switches, budget=4 * budget, seed=seed
        )
        beginnings.append(alone.commands.until(revealed_s))
    best: Shared | None = None
    for prefix in beginnings:
        found: list[Best] = []
        limit_m_s = math.inf if best is None else best.worst_m_s
        for case, span_s in zip(cases, spans, strict=True):
            if revealed_s >= span_s:
                shooter = Shooter(parameters, case, span_s)
                found.append(Best(prefix, shooter.arrival(prefix), 1))
            else:
                found.append(
                    clairvoyant(
                        parameters,
                        case,
                        span_s,
                        most_switches=most_switches,
                        budget=budget,
                        refined=1,
                        seed=seed,
                        given=prefix,
                        from_s=revealed_s,
                    )
                )
            if found[-1].arrival.speed_m_s >= limit_m_s:
                break
        else:
            worst_m_s = max(each.arrival.speed_m_s for each in found)
            if worst_m_s < limit_m_s:
                best = Shared(revealed_s, prefix, worst_m_s, tuple(found))
    if best is None:
        raise RunError("no shared beginning lets every load arrive in its time")
    return best


def line_over_delay(
    parameters: ParameterSet,
    cases: Sequence[LoadCase],
    delays_s: Sequence[float],
    extra_s: float,
    *,
    levels: int = 4,
    budget: int = 30,
    most_switches: int = 4,
) -> list[tuple[float, float]]:
    """(information delay, best worst-case impact speed), rising with the delay.

    Commands shared for longer are also shared for less, so a later delay's result holds for every
    shorter one.
    """
    found: list[tuple[float, float]] = []
    least_m_s = math.inf
    for delay_s in sorted(delays_s, reverse=True):
        shared = non_anticipating(
            parameters,
            cases,
            delay_s,
            extra_s,
            levels=levels,
            budget=budget,
            most_switches=most_switches,
        )
        least_m_s = min(least_m_s, shared.worst_m_s)
        found.append((delay_s, least_m_s))
    return found[::-1]
