"""Replace the programmes of strategy learned that are beyond the limits too often.

python -m tests.bench._learned_risk FILE

`_learned_programmes` proves a programme in draws that are at most 4.3 standard deviations away; of eight
numbers that scatter, 1.8 % of all draws are further. Here the probability that a shift is beyond the
limits is estimated by importance sampling: directions at random, distances from `NEAREST` to
`FARTHEST` standard deviations, each draw weighted by the density of its distance (chi, eight
degrees of freedom; nearer than `NEAREST` the proof is relied on). Where it is above `RISK`, the best
programme of the rows nearby that is not, and that passes the proof as well, takes its place; where
there is none, the push is left plain. Half an hour on one core.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi

from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.systems.setup import make_setup
from sil.studies.kinds.learned import HARDER_M_S, LONGER_S
from sil.studies.policies import PUSH, Floats, Ints
from tests.bench._learned_programmes import (
    FAR,
    IMPULSES_N_S,
    MESH_N,
    NEAR,
    NONE,
    OPEN_S,
    SD,
    SOME,
    STRENGTHS,
    Draws,
    Pushes,
    Strength,
    read,
    tidy,
    varied,
)

COUNT, NEAREST, FARTHEST = 1000, 4.0, 5.75
RISK = 2e-5
"""Probability beyond the limits, if the unit knows no more than it must, above which none is taken."""
ROW_SD = 0.0185
"""Scatter of the impulse within a row, relative: the rows are 6.5 % apart."""
MESH, IMPULSE = (Parameters.fields[name].start for name in ("mesh_force", "sync_impulse"))
BEST = 60
"""Programmes that are compared in all near draws."""
EVERY: Ints = np.arange(COUNT)


def far_draws() -> tuple[Floats, Floats]:
    """Return deviations [COUNT, 1 + len(SD)] in standard deviations, and the weight [COUNT] of each."""
    rng = np.random.default_rng(5)
    drawn = rng.standard_normal((COUNT, 1 + len(SD)))
    distance = rng.uniform(NEAREST, FARTHEST, COUNT)
    drawn *= (distance / np.linalg.norm(drawn, axis=1))[:, None]
    weight: Floats = chi.pdf(distance, drawn.shape[1]) * (FARTHEST - NEAREST) / COUNT
    return drawn, weight


DRAWN, WEIGHT = far_draws()


def setups(bar: float) -> list[Setup]:
    """Return the draws under a supply pressure, without their impulse and meshing force."""
    names = list(SD)
    found = []
    for z in DRAWN[:, 1:]:
        factors = {each: round(float(np.exp(SD[each] * z[names.index(each)])), 2)
                   for each in ("friction", "inlet", "exhaust")}  # fmt: skip
        supply = float(np.clip(SD["supply"] * z[names.index("supply")], -0.035, 0.035))
        case = replace(PUSH, supply_pressure_pa=1e5 * bar * (1.0 + supply), mounted=True,
                       mesh_force_n=MESH_N, sync_impulse_n_s=60.0)  # fmt: skip
        found.append(make_setup(varied(**factors), case))
    return found


class Tail(Pushes):
    """The far draws under one supply pressure; `aim` gives them a row's impulse, force and delays."""

    def __init__(self, bar: float) -> None:
        delays_s = np.full((3, COUNT), OPEN_S)
        super().__init__(setups(bar), delays_s, delays_s)

    def aim(self, strength: Strength, close_s: float, impulse_n_s: float) -> None:
        """Take what is known to a strength at one impulse and closing delay."""
        small, large = strength.impulse
        sd = np.hypot(np.interp(impulse_n_s, (60.0, 110.0), (small, large)), ROW_SD)
        (heavier, more), (lighter, less) = strength.mesh, strength.lighter
        z = DRAWN[:, 1]
        packed = self._base.packed.copy()
        packed[:, MESH] = MESH_N * np.exp(np.where(z > 0.0, heavier + more * z, lighter + less * z))
        packed[:, IMPULSE] = impulse_n_s * np.exp(sd * DRAWN[:, 0])
        self._base = replace(self._base, packed=packed)
        delays = {name: SD[name] * DRAWN[:, 1 + list(SD).index(name)] for name in ("rise", "fall")}
        self._rise_s = np.tile(OPEN_S + delays["rise"], (3, 1))
        self._fall_s = np.tile(close_s + delays["fall"], (3, 1))
        self.limit_s = np.full(COUNT, 0.5)
        plain = self.under(NONE, range(COUNT))
        self.plain_m_s, self.limit_s = plain.cost_m_s[0], plain.arrival_s[0] + LONGER_S

    def fails(self, programme: Floats, which: Ints = EVERY) -> Ints:
        """Return those of some draws in which a programme [2, 4] is beyond the limits."""
        cost_m_s = self.under(programme[None], which.tolist()).cost_m_s[0]
        found: Ints = which[cost_m_s > self.plain_m_s[which] + HARDER_M_S]
        return found


def risk(fails: Ints) -> float:
    """Return the probability of the draws in which a programme is beyond the limits."""
    return float(WEIGHT[fails].sum())


def replacement(tail: Tail, model: Draws, pool: Floats, failed: Ints) -> Floats:
    """Return the best programme [2, 4] of a pool [n, 2, 4] that is neither refused nor too risky.

    failed: draws in which the one to be replaced is beyond the limits; these are tried first.
    """
    few, every = SOME, list(range(NEAR + 8 + FAR))
    pool = np.unique(np.concatenate([pool, NONE]), axis=0)
    pool = pool[np.argsort(model.costs(pool, few), kind="stable")[:BEST]]
    costs = model.costs(pool, every)
    enough = model.costs(NONE, every)[0] - 0.01
    for at in np.argsort(costs, kind="stable"):
        if costs[at] >= enough:
            break
        if risk(tail.fails(pool[at], failed)) > RISK or model.failed(pool[at]):
            continue
        fails = tail.fails(pool[at])
        if risk(fails) <= RISK:
            return np.asarray(pool[at])
        failed = np.union1d(failed, fails)
    return NONE[0]


def mended(line: str, tail: Tail, pool: Floats, risks: list[tuple[float, float]]) -> str:
    """Return a line of the tables, the programmes that are too risky replaced; note the risks."""
    head, *lines = line.split(";")
    bar, close_ms, impulse_n_s, _ = map(float, head.split(","))
    row_n_s = float(IMPULSES_N_S[np.argmin(np.abs(IMPULSES_N_S - impulse_n_s))])
    for k, strength in enumerate(STRENGTHS):
        steps = np.array(lines[k].split(",")[2:], dtype=float).reshape(2, 4)
        if not (steps[:, 1::2] > 0.0).any():
            continue
        tail.aim(strength, 1e-3 * close_ms, row_n_s)
        failed = tail.fails(steps)
        before = after = risk(failed)
        if before > RISK:
            model = Draws(strength, bar, 1e-3 * close_ms, row_n_s)
            found = replacement(tail, model, pool, failed)
            after = risk(tail.fails(found))
            lines[k] = model.line(found)
            print(f"{head} {strength.name}: {before:.1e}, then {after:.1e}: {lines[k]}", flush=True)
        risks.append((before, after))
    return ";".join([head, *lines])


def main(path: Path) -> None:
    """Mend the tables of a file, and print the mean risk of its programmes before and after."""
    given, tails = read(path), dict[float, Tail]()
    risks: list[tuple[float, float]] = []
    text = path.read_text().splitlines()
    for k, line in enumerate(text):
        if line.startswith("#"):
            continue
        bar, close_ms, impulse_n_s = map(float, line.split(",")[:3])
        n = int(np.argmin(np.abs(IMPULSES_N_S - impulse_n_s)))
        near = [
            programmes
            for (p, c, m), programmes in given.items()
            if abs(p - bar) < 0.6 and abs(c - close_ms) < 5.0 and abs(m - n) < 3
        ]
        if bar not in tails:
            tails[bar] = Tail(bar)
        text[k] = mended(line, tails[bar], tidy(np.concatenate(near)), risks)
    path.write_text("\n".join(text) + "\n")
    before, after = np.mean(risks, axis=0)
    print(f"{len(risks)} programmes, mean risk {before:.1e} before, {after:.1e} after")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
