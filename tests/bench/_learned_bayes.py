"""How soft trials alone could make a truck's shifts, and what they cost: Bayesian optimisation.

python -m tests.bench._learned_bayes FIRST LAST SHIFTS

A reference, no strategy: it may compute without a limit, reads speeds without scatter, is given impact
and lost time of every shift against the plain push in the same shift, and keeps all of them. One
Gaussian process models by how much harder a shift is, one how much later; context is what a unit knows
before the shift. Each shift takes, of many programmes (two fillings of the neutral chamber at most), the
one of the largest expected improvement times the probability of being inside the limits; "cautious"
only those whose probability is 0.95. Ends of fillings are commanded as by `_learned_programmes`.
Trucks of the shipped population (seed `SEED`), without air in neutral, in the plant alone.
Sources: Krause and Ong 2011 (processes over context and action), Gardner and others 2014 (expected
improvement under constraints), Rasmussen and Williams 2006 (equations 2.25, 2.26, 2.30, 4.17).
Checked by: tests/unit/sil/test_learned_bayes.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import copysign, exp, log
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.stats import norm

from controller.programmes import library
from controller.strategies.learned import COLDEST_K, DRAG_FOLD_K, REFERENCE_K, WARM_K, WARMEST_K
from plant.batch.batch import Strokes
from plant.systems.setup import make_setup
from sil.studies.fleet import OWN, Drawn, FleetTable, Truck, truck_table
from sil.studies.kinds.learned import HARDER_M_S, LONGER_S, Make, nominal, run_shifts
from sil.studies.load_study import load_study
from sil.studies.policies import PUSH, Family, FamilyModel, Floats
from tests.bench._learned_programmes import DUMMY_S, NONE, Pushes, grid, tidy, varied

SEED, EXAMINED, BLOCKS = 23, (50, 100, 500), (0, 50, 100, 200, 500)
LATEST_S = 0.06
"""A shift that is later than this, or fails, counts as so late: a stall of 0.2 s would hide, as noise,
what a few ms do. Chosen with the two probabilities by truck 0 (0.045, 0.06, 0.15 s)."""
EXAM, SOME = 0.9, 1500
"""Least probability of being inside the limits in an examination; programmes of which one is taken."""
STEPS, LENGTH_MS = 2, 20.0
"""Random changes of a filling from `grid`: of its first step at most, and of its length (sd)."""
REFIT = (15, 30, 60, 120, 240, 480)
"""Shifts after which the kernels are fitted anew."""
LENGTHS = np.array((0.6, 0.4, 4.0, 1.0, 2.0, 0.03, 0.03, 0.03, 0.03))
"""Of context and programme as `Shifts.inputs` has them, before anything is learned."""
CLOSED = {"open loop": {}, "learned": {"controller.strategy": "learned"},
          "oil damper": {"plant.damper": "compressible"}}  # fmt: skip
TRIALS = {"by trials": 0.0, "by trials, cautious": 0.95}
EFFECTS = {"friction": "dynamic_friction", "inlet": "inlet_clog", "exhaust": "exhaust_clog"}
CLOSE_S = 0.035
"""Closing delay of a valve at 20 degrees Celsius after a long full duty."""
SHORT_S = 0.015
"""The same after a filling: its end is off by the error of the closing delay times this."""


@dataclass(frozen=True)
class Process:
    """A Gaussian process of mean zero with a Matern kernel (5/2): sd, noise, lengths [dimensions]."""

    sd: float
    noise: float
    lengths: Floats

    def kernel(self, a: Floats, b: Floats) -> Floats:
        """Return the covariances [n, m] of inputs [n, dimensions] and [m, dimensions]."""
        a, b = a / self.lengths, b / self.lengths
        square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        r = np.sqrt(5.0 * np.maximum(square, 0.0))
        return np.asarray(self.sd**2 * (1.0 + r + r**2 / 3.0) * np.exp(-r))

    def root(self, x: Floats) -> Floats:
        """Return the lower Cholesky factor of the covariance of noisy values at x."""
        noisy = self.kernel(x, x) + (self.noise**2 + 1e-10) * np.eye(len(x))
        return np.asarray(cholesky(noisy, lower=True))

    def at(self, new: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return mean and standard deviation at `new`, given values y at x."""
        if not len(x):
            return np.zeros(len(new)), np.full(len(new), self.sd)
        root, between = self.root(x), self.kernel(x, new)
        explained = (solve_triangular(root, between, lower=True) ** 2).sum(axis=0)
        mean = between.T @ cho_solve((root, True), y)
        return mean, np.sqrt(np.maximum(self.sd**2 - explained, 1e-12))

    def log_evidence(self, x: Floats, y: Floats) -> float:
        """Return the logarithm of the probability density of values y at x."""
        root = self.root(x)
        half = solve_triangular(root, y, lower=True)
        spread = np.log(np.diag(root)).sum() + 0.5 * len(x) * log(2.0 * np.pi)
        return float(-0.5 * half @ half - spread)

    def fitted(self, x: Floats, y: Floats) -> Process:
        """Return the most probable numbers; before, each is known to a factor of some 2 (1 sd)."""
        start = np.log([self.sd, self.noise, *self.lengths])

        def made(logs: Floats) -> Process:
            return Process(exp(logs[0]), exp(logs[1]), np.exp(logs[2:]))

        def cost(logs: Floats) -> float:
            return float(((logs - start) ** 2).sum()) - made(logs).log_evidence(x, y)

        bounds = [(each - 3.0, each + 3.0) for each in start]
        return made(minimize(cost, start, bounds=bounds, options={"maxiter": 25}).x)


BEFORE = Process(0.2, 0.04, LENGTHS), Process(0.04, 0.006, LENGTHS)
"""By how much harder, m/s, and later, s, than the plain push: before any shift."""


class Shifts(Pushes):
    """Drawn shifts of a truck in the plant, and what its unit knows before each of them.

    Of the base only `under` is used: the shifts have setups and valves of their own.
    """

    def __init__(self, drawn: Sequence[Drawn]) -> None:
        setups, self.context, self.expected_s, closing = [], [], [], []
        for each in drawn:
            of, supply_pa = each.settings, each.known[f"{OWN}.supply_pa"]
            factors = {k: round(of[f"effect.{name}.factor"], 2) for k, name in EFFECTS.items()}
            case = replace(PUSH, supply_pressure_pa=of["plant.supply_pressure_pa"], mounted=True,
                           mesh_force_n=of["plant.mesh_force_n"],
                           sync_impulse_n_s=each.impulse_n_s)  # fmt: skip
            setups.append(make_setup(varied(**factors), case))
            coil_k = min(max(of["sensor.measured_temperature_k"], COLDEST_K), WARMEST_K)
            close_s = CLOSE_S * exp(-0.0065 * (coil_k - REFERENCE_K))
            closing.append(of["valve.D_fall"] / close_s - 1.0)
            known = log(each.expected_n_s)
            self.expected_s.append(library().near(supply_pa).release(known)[0])
            drag = copysign(exp((WARM_K - coil_k) / DRAG_FOLD_K), of["driveline.residual_rad_s"])
            gear = float(of["request"][0]["gear"] == "forward")
            self.context.append([known, 1e-5 * supply_pa, 1e3 * close_s, gear, drag])
        self._rise_s = np.tile([each.settings["valve.D_rise"] for each in drawn], (3, 1))
        self._fall_s = np.tile(DUMMY_S + SHORT_S * np.array(closing), (3, 1))
        family = Family("g", "unblock", (setups[0].conditions,))
        FamilyModel.__init__(self, varied(), family, 0.0, 0.0)
        self.loads, self._base = len(setups), Strokes.from_setups(setups, 1.0)
        self.limit_s = np.full(self.loads, 0.6)
        self.plain = self.under(NONE, np.arange(self.loads))
        self.plain_m_s = self.plain.cost_m_s[0]
        self.limit_s = self.plain.arrival_s[0] + 2.0 * LATEST_S

    def inputs(self, k: int, programmes: Floats) -> Floats:
        """Return context and programmes [n, dimensions]."""
        context = np.tile(self.context[k], (len(programmes), 1))
        return np.column_stack([context, acts(programmes, self.expected_s[k])])

    def outcome(self, k: int, programme: Floats) -> tuple[float, float]:
        """Return by how much harder, m/s, and later, s, a programme is than the plain push."""
        found = self.under(programme[None], np.array([k]))
        late_s = min(found.arrival_s[0, 0] - self.plain.arrival_s[0, k], LATEST_S)
        impact_m_s = found.cost_m_s[0, 0] if late_s < LATEST_S else self.plain_m_s[k]
        return impact_m_s - self.plain_m_s[k], late_s


def acts(programmes: Floats, release_s: float) -> Floats:
    """Return programmes [n, 4] as start and length, s, of the first filling, then of the last one.

    Starts are counted from a release; one filling alone is the last one.
    """
    last = np.where(programmes[:, 2:3] < 0.0, programmes[:, [2, 3, 0, 1]], programmes)
    start_s, none = 0.01 * last[:, 0::2], last[:, 0::2] < 0.0
    length_s = np.where(none, 0.0, 0.001 * last[:, 1::2] - start_s)
    start_s = np.where(none, -0.03, start_s - release_s)
    return np.stack([start_s, length_s], axis=2).reshape(-1, 4)


def candidates(release_s: float, rng: np.random.Generator) -> Floats:
    """Return programmes [1 + SOME, 4] near a release: no filling, then random changes of `grid`."""
    made = rng.choice(grid(release_s), SOME)
    steps = rng.integers(-STEPS, STEPS, (SOME, 2), endpoint=True)
    filled = made[:, 0::2] >= 0.0
    made[:, 0::2] += filled * steps
    made[:, 1::2] += filled * (10.0 * steps + LENGTH_MS * rng.standard_normal((SOME, 2)))
    return np.concatenate([NONE, tidy(made)])


def by_trials(shifts: Shifts, exams: Mapping[int, Shifts], least: float) -> Iterator[Floats]:
    """Yield by how much harder and later [shifts, 2] the shifts were, then those of examinations.

    least: probability of being inside the limits that a trial needs.
    """
    rng, processes = np.random.default_rng(SEED), BEFORE
    x, y, examined = np.zeros((0, len(LENGTHS))), np.zeros((0, 2)), []

    def choose(of: Shifts, k: int, least: float, exam: bool = False) -> Floats:
        some = candidates(of.expected_s[k], rng)
        (harder, by), (later, late_by) = (
            process.at(of.inputs(k, some), x, values)
            for process, values in zip(processes, y.T, strict=True)
        )
        of_shift, of_late = (
            np.hypot(sd, process.noise)
            for sd, process in zip((by, late_by), processes, strict=True)
        )
        inside = norm.cdf((LONGER_S - later) / of_late)
        inside *= norm.cdf((HARDER_M_S - harder) / of_shift)
        harder[0], inside[0] = 0.0, 1.0  # the plain push, by which both are counted
        best = np.where(inside >= max(least, 0.5), harder, np.inf)
        gain = (best.min() - harder) / by
        expected = inside * by * (gain * norm.cdf(gain) + norm.pdf(gain)) * (inside >= least)
        expected[0] = 0.0
        return np.asarray(some[np.argmin(best) if exam else np.argmax(expected)])

    for k in range(shifts.loads):
        programme = choose(shifts, k, least)
        x = np.vstack([x, shifts.inputs(k, programme[None])])
        y = np.vstack([y, shifts.outcome(k, programme)])
        if k + 1 in REFIT:
            processes = BEFORE[0].fitted(x, y[:, 0]), BEFORE[1].fitted(x, y[:, 1])
        if exam := exams.get(k + 1):
            chosen = [choose(exam, j, EXAM, exam=True) for j in range(exam.loads)]
            examined.append(np.array([exam.outcome(j, each) for j, each in enumerate(chosen)]))
    yield from (y, *examined)


def closed_loop(
    make: Make, own: Mapping[str, Any], drawn: list[Drawn], exams: Mapping[int, list[Drawn]]
) -> Iterator[Floats]:
    """Yield the same of a strategy, or of other hardware, in the closed loop."""
    found = list(run_shifts(make, own, drawn))
    memory = [found[at - 1].memory for at in exams]
    examined = [[next(run_shifts(make, own, [each], before)) for each in shifts]
                for before, shifts in zip(memory, exams.values(), strict=True)]  # fmt: skip
    for ran, shifts in zip((found, *examined), (drawn, *exams.values()), strict=True):
        pairs = zip(ran, run_shifts(make, {}, shifts), strict=True)
        yield np.array([(a.impact_m_s - b.impact_m_s, a.time_s - b.time_s) for a, b in pairs])


def main(first: int, last: int, count: int) -> None:
    """Print for each truck and method the median impact and shifts beyond the limits by block of shifts,
    then worst and median impact, and shifts beyond the limits, of each examination."""
    study = load_study("learned")
    assert study.study.truck is not None
    table = truck_table(study.study.truck, {"direct": 0.0})
    for number in range(first, last + 1):
        exams: dict[int, list[Drawn]] = {}
        for at in (*(each for each in EXAMINED if each <= count), 0):
            fleet = FleetTable(shifts=count, seed=SEED, examined_after=at)
            truck = Truck(table, study.study.factor, fleet, number, nominal(study, {}))
            drawn, exams[at] = truck.shifts()
        del exams[0]
        shifts, alone = Shifts(drawn), {at: Shifts(each) for at, each in exams.items()}
        runs = {name: closed_loop(study.loaded, own, drawn, exams) for name, own in CLOSED.items()}
        runs |= {name: by_trials(shifts, alone, least) for name, least in TRIALS.items()}
        for name, run in runs.items():
            parts = list(zip((shifts, *alone.values()), run, strict=True))
            (_, ran), *_ = parts
            text = []
            for a, b in pairwise([*(each for each in BLOCKS if each < count), count]):
                impact_m_s = shifts.plain_m_s[a:b] + ran[a:b, 0]
                text.append(f"{a + 1}-{b} {np.median(impact_m_s):.2f} ({beyond(ran[a:b])})")
            for at, (exam, did) in zip(exams, parts[1:], strict=True):
                impact_m_s = exam.plain_m_s + did[:, 0]
                text.append(
                    f"after {at} {impact_m_s.max():.2f} {np.median(impact_m_s):.2f} ({beyond(did)})"
                )
            print(number, name, "; ".join(text), flush=True)


def beyond(ran: Floats) -> int:
    """Return the number of shifts [n, 2] that are harder or longer than the limits."""
    return int(((ran[:, 0] > HARDER_M_S) | (ran[:, 1] > LONGER_S)).sum())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]))
