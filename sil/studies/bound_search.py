"""Search the softest worst-case arrival over the loads of a family.

(a) Clairvoyant: the load is known in advance, and the commands of the driving and of the neutral
valve may change at any times, six in all.
(b) Non-anticipating: a policy is a stem of commands that all loads of a family share, and for each
load an ending of its own that begins at the event that reveals the load plus the information delay.
That is everything a controller with that delay can do, however it computes. A negative delay means
that the event is known ahead.

Both are minima over switching times found by a search on the plant's own equations (random starts
for every pattern, the best refined). Each value is thus a policy that exists: an upper estimate of
the true bound. No proof gives a lower one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plant.parameters import ParameterSet
from sil.studies.shooting import Arrivals, Commands, Family, Floats, Shooter, plain_push

MOST_SWITCHES = 6
BUDGET = 60
"""Starting sequences of each pattern."""
LEAST_STEP_S = 5e-5
OFFSPRING = 24
MOVED_SHARE = 0.6
"""Sequences tried in a step of the scattered search, and the share of times that each moves."""
ROUNDS = 2
PATTERNS_REFINED = 12
"""How often a known load is searched, and how many patterns' best starts are refined each time."""
LATE_S = 0.06
"""Half of the starting times are drawn from this interval before the limit, which decides the stop."""


@dataclass(frozen=True)
class Best:
    """The best sequence found under one load, and how it arrives."""

    commands: Commands
    speed_m_s: float
    time_s: float


def patterns(most_switches: int) -> Iterator[tuple[int, int]]:
    """Yield the numbers of changes of (driving, neutral), up to `most_switches` together."""
    for total in range(most_switches + 1):
        for driving in range(total + 1):
            yield driving, total - driving


def starts(
    from_s: float, limit_s: float, most_switches: int, budget: int, rng: np.random.Generator
) -> list[Commands]:
    """Return starting sequences: of each pattern all at once, and random ones over the time and its end."""
    late_s = max(from_s, limit_s - LATE_S)
    found = []
    for driving, braking in patterns(most_switches):
        if driving + braking == 0:
            found.append(Commands())
            continue
        at_once = [from_s + 1e-6 * k for k in range(max(driving, braking))]
        found.append(Commands(tuple(at_once[:driving]), tuple(at_once[:braking])))
        for k in range(budget):
            low_s = from_s if k % 2 else late_s
            draws = low_s + (limit_s - low_s) * rng.random(driving + braking)
            found.append(
                Commands(
                    tuple(sorted(map(float, draws[:driving]))),
                    tuple(sorted(map(float, draws[driving:]))),
                )
            )
    return found


def neighbours(commands: Commands, step_s: float, from_s: float) -> list[Commands]:
    """Return the sequences that differ in one time by a step either way, in the same order."""
    found = []
    for which in ("driving_s", "braking_s"):
        times = getattr(commands, which)
        for k in range(len(times)):
            for sign in (1.0, -1.0):
                moved = list(times)
                moved[k] = max(from_s, moved[k] + sign * step_s)
                if moved == sorted(moved) and moved != list(times):
                    found.append(replace(commands, **{which: tuple(moved)}))
    return found


def scattered(shooter: Shooter, best: Best, step_s: float, rng: np.random.Generator) -> Best:
    """Move several times at once by normal steps, wider while that helps, smaller when not."""
    count = len(best.commands.driving_s)
    times = (*best.commands.driving_s, *best.commands.braking_s)
    widest_s = step_s
    while times and step_s >= LEAST_STEP_S:
        chosen = rng.random((OFFSPRING, len(times))) < MOVED_SHARE
        steps = step_s * rng.standard_normal((OFFSPRING, len(times))) * chosen
        moved = []
        for each in np.maximum(np.array(times) + steps, 0.0):
            driving, braking = sorted(map(float, each[:count])), sorted(map(float, each[count:]))
            moved.append(Commands(tuple(driving), tuple(braking)))
        found = shooter.shoot(moved)
        k = int(np.argmin(found.speed_m_s))
        if found.speed_m_s[k] < best.speed_m_s:
            times = (*moved[k].driving_s, *moved[k].braking_s)
            best = Best(moved[k], float(found.speed_m_s[k]), float(found.time_s[k]))
            step_s = min(1.3 * step_s, widest_s)
        else:
            step_s *= 0.7
    return best


def refined(shooter: Shooter, best: Best, fixed: Commands, from_s: float, step_s: float) -> Best:
    """Move one time after the other, halving the step: no result is worse than the start."""
    tail = Commands(
        best.commands.driving_s[len(fixed.driving_s) :],
        best.commands.braking_s[len(fixed.braking_s) :],
    )
    while step_s >= LEAST_STEP_S:
        moved = neighbours(tail, step_s, from_s)
        if not moved:
            break
        found = shooter.shoot([fixed.then(each) for each in moved])
        k = int(np.argmin(found.speed_m_s))
        if found.speed_m_s[k] < best.speed_m_s:
            tail = moved[k]
            best = Best(fixed.then(tail), float(found.speed_m_s[k]), float(found.time_s[k]))
        else:
            step_s *= 0.5
    return best


def ending(
    shooter: Shooter,
    fixed: Commands,
    from_s: float,
    *,
    most_switches: int,
    budget: int,
    rng: np.random.Generator,
    refine: int = 3,
) -> Best:
    """Return the softest arrival when `fixed` has been commanded and all after `from_s` is free."""
    from_s = max(from_s, 0.0)
    if from_s >= shooter.limit_s:
        plain = shooter.shoot([fixed])
        return Best(fixed, float(plain.speed_m_s[0]), float(plain.time_s[0]))
    tails = starts(from_s, shooter.limit_s, most_switches, budget, rng)
    found = shooter.shoot([fixed.then(tail) for tail in tails])
    order = np.argsort(found.speed_m_s, kind="stable")[:refine]
    step_s = 0.1 * min(LATE_S, shooter.limit_s - from_s)
    results = []
    for k in order:
        first = Best(fixed.then(tails[k]), float(found.speed_m_s[k]), float(found.time_s[k]))
        results.append(refined(shooter, first, fixed, from_s, step_s))
    return min(results, key=lambda one: one.speed_m_s)


def best_of_patterns(tails: Sequence[Commands], speed_m_s: Floats) -> list[int]:
    """Return the index of the best start of each pattern, the best first; speed_m_s: [tails] in m/s."""
    found: dict[tuple[int, int], int] = {}
    for k in np.argsort(speed_m_s, kind="stable"):
        tail = tails[int(k)]
        found.setdefault((len(tail.driving_s), len(tail.braking_s)), int(k))
    return list(found.values())


def clairvoyant(
    shooter: Shooter,
    *,
    most_switches: int = MOST_SWITCHES,
    budget: int = BUDGET,
    seed: int = 0,
    rounds: int = ROUNDS,
    patterns_refined: int = PATTERNS_REFINED,
) -> Best:
    """Return the best sequence for a load that is known in advance, from several wide searches."""
    tries = []
    for number in range(rounds):
        rng = np.random.default_rng([seed, number])
        sequences = starts(0.0, shooter.limit_s, most_switches, budget, rng)
        found = shooter.shoot(sequences)
        for k in best_of_patterns(sequences, found.speed_m_s)[:patterns_refined]:
            first = Best(sequences[k], float(found.speed_m_s[k]), float(found.time_s[k]))
            tries.append(scattered(shooter, first, 0.1 * LATE_S, rng))
    best = min(tries, key=lambda one: one.speed_m_s)
    return refined(shooter, best, Commands(), 0.0, 8.0 * LEAST_STEP_S)


@dataclass(frozen=True)
class Bound:
    """Worst impact speeds over a family: plain push, oil damper, bounds (a) and (b), m/s.

    stem: the shared commands of (b); per_load: its sequences; runs: simulations made.
    """

    open_loop_m_s: float
    damper_m_s: float
    clairvoyant_m_s: float
    non_anticipating_m_s: float
    stem: Commands
    per_load: tuple[Best, ...]
    runs: int


def shooters_of(parameters: ParameterSet, family: Family, extra_s: float) -> list[Shooter]:
    """Return a shooter for each load; its limit is the arrival of the plain push plus `extra_s`."""
    return [
        Shooter(
            parameters,
            case,
            plain_push(parameters, case, family.revealed_by)[1] + extra_s,
            family.revealed_by,
        )
        for case in family.cases
    ]


def bound(
    parameters: ParameterSet,
    family: Family,
    delay_s: float,
    extra_s: float,
    *,
    most_switches: int = MOST_SWITCHES,
    budget: int = BUDGET,
    stems: int = 8,
    seed: int = 0,
    known_m_s: Sequence[float] = (),
) -> Bound:
    """Return bounds (a) and (b) of a family at an information delay; see the module.

    extra_s: how much later than the plain push a load may arrive. budget: starting sequences of each
    pattern. stems: number of shared beginnings for which endings are searched. known_m_s: result of
    `clairvoyant` for each load, which does not depend on the delay; without it, (a) is the best that
    the search of (b) finds.
    """
    rng = np.random.default_rng(seed)
    shooters = shooters_of(parameters, family, extra_s)
    known = [
        ending(each, Commands(), 0.0, most_switches=most_switches, budget=budget, rng=rng)
        for each in shooters
    ]
    chosen = best_stems(shooters, known, most_switches, 4 * budget, stems, rng)
    winner: tuple[float, Commands, tuple[Best, ...]] | None = None
    for stem in chosen:
        limit_m_s = math.inf if winner is None else winner[0]
        endings = []
        for shooter in shooters:
            endings.append(own_ending(shooter, stem, delay_s, most_switches, budget // 2, rng))
            if endings[-1].speed_m_s >= limit_m_s:
                break
        else:
            worst_m_s = max(each.speed_m_s for each in endings)
            winner = (worst_m_s, stem, tuple(endings))
    assert winner is not None  # the plain push is among the stems, and arrives
    worst_m_s, stem, endings_of = winner
    softest = [min(a.speed_m_s, b.speed_m_s) for a, b in zip(known, endings_of, strict=True)]
    if known_m_s:
        softest = [min(pair) for pair in zip(softest, known_m_s, strict=True)]
    return Bound(
        open_loop_m_s=max(plain_push(parameters, c, family.revealed_by)[0] for c in family.cases),
        damper_m_s=max(
            plain_push(parameters, replace(c, damper=True), family.revealed_by)[0]
            for c in family.cases
        ),
        clairvoyant_m_s=max(softest),
        non_anticipating_m_s=worst_m_s,
        stem=stem,
        per_load=endings_of,
        runs=sum(each.runs for each in shooters),
    )


def own_ending(
    shooter: Shooter,
    stem: Commands,
    delay_s: float,
    most_switches: int,
    budget: int,
    rng: np.random.Generator,
) -> Best:
    """Return the best ending of one load from its revealing event under the stem plus the delay."""
    plain = shooter.shoot([stem])
    free_from_s = float(plain.revealed_s[0]) + delay_s
    if free_from_s >= min(float(plain.time_s[0]), shooter.limit_s):
        return Best(stem, float(plain.speed_m_s[0]), float(plain.time_s[0]))
    fixed = stem.until(free_from_s)
    left = max(2, most_switches - fixed.switches)
    free = ending(shooter, fixed, free_from_s, most_switches=left, budget=budget, rng=rng, refine=2)
    if plain.speed_m_s[0] < free.speed_m_s:
        return Best(stem, float(plain.speed_m_s[0]), float(plain.time_s[0]))
    return free


def best_stems(
    shooters: Sequence[Shooter],
    known: Sequence[Best],
    most_switches: int,
    budget: int,
    count: int,
    rng: np.random.Generator,
) -> list[Commands]:
    """Return shared commands for loads that are never told apart, the best refined, and the plain push.

    The best sequences of the single loads are among the starts.
    """
    last_s = max(shooter.limit_s for shooter in shooters)
    pool = [Commands(), *(best.commands for best in known)]
    pool += starts(0.0, last_s, most_switches, budget // 4, rng)

    def worst(sequences: Sequence[Commands]) -> Floats:
        alive = np.arange(len(sequences))
        result = np.full(len(sequences), math.inf)
        top = np.zeros(len(sequences))
        for shooter in reversed(shooters):
            found: Arrivals = shooter.shoot([sequences[int(k)] for k in alive])
            top[alive] = np.maximum(top[alive], found.speed_m_s)
            alive = alive[np.isfinite(top[alive])]
            if not len(alive):
                return result
        result[alive] = top[alive]
        return result

    values = worst(pool)
    order = np.argsort(values, kind="stable")[: count - 1]
    found = []
    for k in order:
        stem, value, step_s = pool[int(k)], float(values[k]), 0.004
        while step_s >= 2.0 * LEAST_STEP_S and math.isfinite(value):
            moved = neighbours(stem, step_s, 0.0)
            if not moved:
                break
            tried = worst(moved)
            j = int(np.argmin(tried))
            if tried[j] < value:
                stem, value = moved[j], float(tried[j])
            else:
                step_s *= 0.5
        found.append((value, stem))
    found.sort(key=lambda item: item[0])
    return [stem for _value, stem in found] + [Commands()]
