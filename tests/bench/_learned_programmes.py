"""Search the programmes of `controller/programmes.csv`, the tables of strategy learned.

python -m tests.bench._learned_programmes FILE

For each supply pressure, closing delay and impulse: programmes of at most two spans of venting the
driving chamber and two of filling the neutral one, in steps of 10 ms. Judged by the hardest of all
impacts, under an impulse and a meshing force that are off by their scatter; a programme that is
harder than the plain push, or 28 ms later, under twice that scatter is out of the question. Drawn at
random near the release, then improved step by step, in a second pass from the programmes of all
tables for similar releases. Some hours on one core.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plant.parameters import ParameterSet, load
from sil.studies.policies import PUSH, Family, FamilyModel, Floats, Layout
from sil.studies.pulses import stem_spans

SUPPLY_BAR = (8.0, 8.5, 9.0)
CLOSE_MS = (27.0, 31.0, 35.0, 39.0, 43.0)
IMPULSES_N_S = np.geomspace(16.0, 275.0, 46)
MESH_N = 1300.0
EXTRA_S = 0.028
NEAR = ((0, 0), (2.5, 0), (-2.5, 0), (0, 4), (0, -4), (2.5, 4), (-2.5, -4), (5, 0), (-5, 0))
SAFE = ((9, 0), (-9, 0), (0, 10), (5, 6), (-5, -15))
"""Impulse and meshing force, % off what is expected."""
LAYOUT = Layout("BN", 2, 0)
DRAWN, POOL, PARENTS, CHILDREN = 450, 40, 8, 48


@dataclass
class Row:
    """The best programme so far [2, 4] for an impulse, its cost, and the releases in s."""

    impulse_n_s: float
    plain_s: float
    released_s: float
    gain: float
    programme: Floats
    cost: float


class Loads:
    """One impulse with its scatter."""

    def __init__(self, parameters: ParameterSet, supply_pa: float, impulse_n_s: float) -> None:
        # what the speeds tell meanwhile makes large impulses better known
        share = float(np.clip(1.0 - 0.4 * (impulse_n_s - 60.0) / 30.0, 0.6, 1.0))
        cases = tuple(
            replace(
                PUSH,
                supply_pressure_pa=supply_pa,
                mounted=True,
                mesh_force_n=MESH_N * (1.0 + 0.01 * mesh),
                sync_impulse_n_s=impulse_n_s * (1.0 + 0.01 * share * impulse),
            )
            for impulse, mesh in (*NEAR, *SAFE)
        )
        self.impulse_n_s = impulse_n_s
        self.model = FamilyModel(parameters, Family("g", "unblock", cases), 0.0, EXTRA_S)
        self.plain_m_s = self.model.plain.cost_m_s[0, 0]
        self.plain_s = self.model.plain.revealed_s[0, 0]

    def fly(self, programmes: Floats, which: list[int]) -> tuple[Floats, Floats]:
        """Return costs and releases [n, which] of programmes [n, 2, 4]."""
        given = self.model.changes(LAYOUT, *stem_spans(programmes))
        repeated = [np.repeat(each, len(which), axis=0) for each in given]
        found = self.model._simulate(repeated, np.tile(np.array(which), len(programmes)))
        shape = len(programmes), len(which)
        return found.cost_m_s.reshape(shape), found.revealed_s.reshape(shape)

    def costs(self, programmes: Floats) -> Floats:
        """Return mean and worst impact [n], and far more where the scatter makes it unsafe."""
        costs, _ = self.fly(programmes, list(range(len(NEAR) + len(SAFE))))
        near = costs[:, : len(NEAR)]
        unsafe = np.maximum(costs - self.plain_m_s - 0.02, 0.0).max(axis=1)
        found: Floats = near.mean(axis=1) + 0.7 * near.max(axis=1) + 3.0 * unsafe
        return found

    def best(self, pool: Floats, rounds: int, rng: np.random.Generator) -> Row:
        """Return the best of a pool after rounds of small changes."""
        rough, _ = self.fly(pool, [0, 5])
        pool = pool[np.argsort(rough[:, 0] + 0.5 * np.minimum(rough[:, 1], 2.0))[:POOL]]
        costs = self.costs(pool)
        for _ in range(rounds):
            parents = pool[np.argsort(costs)[:PARENTS]]
            children = np.array([self.changed(p, rng) for p in np.repeat(parents, 6, axis=0)])
            new = np.array([not (pool == child).all(axis=(1, 2)).any() for child in children])
            if new.any():
                pool = np.concatenate([pool, children[new]])
                costs = np.concatenate([costs, self.costs(children[new])])
        at = int(np.argmin(costs))
        _, released_s = self.fly(pool[at : at + 1], [0, 1, 2])
        gain = np.diff(released_s[0, 1:])[0] / np.diff(self.plain_s[1:3])[0]
        return Row(
            self.impulse_n_s, self.plain_s[0], released_s[0, 0], gain, pool[at], float(costs[at])
        )

    def drawn(self, rng: np.random.Generator) -> Floats:
        """Return programmes [n, 2, 4] that act near the release."""
        release, found = int(100.0 * self.plain_s[0]), []
        for _ in range(DRAWN):
            vent, brake = (max(0, release - rng.integers(*span)) for span in ((-1, 8), (-2, 6)))
            one = [vent, rng.integers(4, 9), 0, -1], [brake, rng.integers(1, 9), 0, -1]
            if rng.random() < 0.5:
                one[0][2:] = rng.integers(1, max(3, vent - 4)), rng.integers(4, 6)
            if rng.random() < 0.1:
                one[1][2:] = brake + one[1][1] + rng.integers(1, 3), rng.integers(1, 4)
            found.append(one)
        return tidy(np.array(found, dtype=float))

    def changed(self, programme: Floats, rng: np.random.Generator) -> Floats:
        """Return a programme with one to three numbers changed."""
        made = programme.copy()
        for _ in range(rng.integers(1, 4)):
            valve, at = rng.integers(2), rng.integers(4)
            if at % 2 or made[valve, at + 1] > 0.0:
                made[valve, at] = max(made[valve, at] + rng.choice([-1.0, 1.0]), at % 2 - 1.0)
            elif rng.random() < 0.5:
                latest = int(100.0 * self.plain_s[0]) + 2
                made[valve, at : at + 2] = rng.integers(1, latest), 4 - 3 * valve
        return tidy(made)


def tidy(programmes: Floats) -> Floats:
    """Return programmes [..., 2, 4] of which a span that is none is 0, -1, as is a start before 0."""
    made = programmes.copy()
    none = made[..., 1::2] <= 0.0
    made[..., 0::2] = np.where(none, 0.0, np.maximum(made[..., 0::2], 0.0))
    made[..., 1::2] = np.where(none, -1.0, made[..., 1::2])
    return made


def main(path: Path) -> None:
    """Search all tables and write them."""
    rng = np.random.default_rng(0)
    keys = [(close_ms, bar) for close_ms in CLOSE_MS for bar in SUPPLY_BAR]
    tables: dict[tuple[float, float], list[Row]] = {key: [] for key in keys}
    for second in (False, True):
        for key in keys:
            parameters = load("nominal").override({"valve.D_fall": 1e-3 * key[0]})
            rows: list[Row] = []
            for n, impulse_n_s in enumerate(IMPULSES_N_S):
                loads = Loads(parameters, 1e5 * key[1], float(impulse_n_s))
                pools = [loads.drawn(rng), *(row.programme[None] for row in rows[-5:])]
                if second:
                    pools = [
                        tables[key][n].programme[None],
                        *(r.programme[None] for r in rows[-3:]),
                    ]
                    near = [
                        row.programme[None]
                        for each in tables.values()
                        for row in each
                        if abs(row.plain_s - loads.plain_s[0]) < 0.012
                    ]
                    pools += [tidy(p + np.array([a, 0, a, 0])) for p in near for a in (-1, 0, 1)]
                pool = np.unique(np.concatenate(pools), axis=0)
                rows.append(loads.best(pool, 5 if second else 4, rng))
                print(key, rows[-1], flush=True)
            tables[key] = rows
    lines = [
        "# Made by python -m tests.bench._learned_programmes; each line: supply in bar, closing delay",
        "# in ms, impulse in N s, release of the plain push and of the programme in 0.1 ms, change of",
        "# the latter by the former, two spans of venting, two of filling (start, steps; 0,-1: none)",
    ]
    for (close_ms, bar), rows in sorted(tables.items(), key=lambda item: item[0][::-1]):
        for r in rows:
            numbers = f"{r.impulse_n_s:.3f},{1e4 * r.plain_s:.0f},{1e4 * r.released_s:.0f}"
            steps = ",".join(f"{step:.0f}" for step in r.programme.ravel())
            lines.append(f"{bar:g},{close_ms:g},{numbers},{r.gain:.2f},{steps}")
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
