"""Search the programmes of `controller/programmes.csv`, the tables of strategy learned.

python -m tests.bench._learned_programmes FILE [WORKERS]

For each supply pressure, closing delay and impulse: programmes of at most two spans of venting the
driving chamber and two of filling the neutral one, in steps of 10 ms. They are judged under draws of
all that the unit does not know (`Strength`, `SD`): by mean and hardest of all impacts near what is
expected, while 4.3 standard deviations away, in random directions and along single axes, none may be
0.03 m/s harder or 27 ms later than the plain push in the same draw. The best that also stays within
0.04 m/s in 480 more such draws, 60 of them with exchanged valves and 60 with one valve that is
suddenly slow, is taken; where none does, the push is left plain. The search begins with the programmes of FILE, or
with a grid if there is no such file; some six minutes on one core for each strength.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import norm, qmc

from controller.programmes import LEVELS, LIGHTEST, PER_LEVEL
from plant.batch.batch import Strokes
from plant.effects.setup import Setup
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.diagnosis.workers import spread_out
from sil.simulation.load_scenario import load
from sil.studies.policies import PUSH, Arrivals, Family, FamilyModel, Floats, Ints, Layout
from sil.studies.pulses import stem_spans

SUPPLY_BAR = (8.0, 8.5, 9.0)
CLOSE_MS = (27.0, 31.0, 35.0, 39.0)
IMPULSES_N_S = np.geomspace(16.0, 275.0, 46)
MESH_N = 1300.0
OPEN_S = 0.0083
"""Opening delay of a valve at 50 degrees Celsius."""
EXTRA_S, HARDER_M_S = 0.027, 0.03
SD = {"mesh": 0.054, "rise": 0.0004, "fall": 0.0015, "supply": 0.016, "friction": 0.07,
      "inlet": 0.01, "exhaust": 0.01}  # fmt: skip
"""Of trucks and shifts (sil/studies/shipped/learned.toml), and the tables' distance in pressure
and closing delay; in s or relative. That of the meshing force is `Strength`'s where it is known."""
LAYOUT = Layout("BN", 2, 0)
NONE = np.array([[[0.0, -1.0, 0.0, -1.0]] * 2])
NEAR, FAR, PROOF, EXCHANGED, SINGLE, DEVIATIONS = 20, 24, 360, 60, 60, 4.3
SLOWER = 1.2
"""Delays of a single valve that is suddenly slow, by its own: half of them the driving chamber's."""
SOME = [*range(4), *range(NEAR, NEAR + 8)]
ROUNDS, PROOFS = 1, 40
BEST, CHILDREN = 80, 32
FIRST = 2
"""No span begins before this step."""


@dataclass(frozen=True)
class Strength:
    """What is known: impulse to a relative sd (of small and large ones), and meshing force.

    mesh: the heaviest that is to be expected beyond its sd, and that sd towards heavier ones, by the
    force of `MESH_N`. lighter: the heaviest of the lighter ones, and their sd.
    """

    name: str
    impulse: tuple[float, float]
    mesh: tuple[float, float]
    lighter: tuple[float, float] = (0.0, SD["mesh"])


def strong(heavier: float) -> Strength:
    """Return what is known of a gear whose meshing force was found to be at most so much heavier."""
    return Strength(f"strong {heavier:.2f}", (0.04, 0.031), (heavier, 0.025), (heavier, PER_LEVEL))


STRENGTHS = (
    Strength("careful", (0.065, 0.05), (0.09, 0.033)),
    *(strong(LIGHTEST + k * PER_LEVEL) for k in range(LEVELS)),
)
"""The order is that of `controller.programmes`."""


@cache
def varied(**factors: float) -> ParameterSet:
    """Return the parameters with friction and flows changed."""
    names = {"friction": "dynamic_friction", "inlet": "inlet_clog", "exhaust": "exhaust_clog"}
    given = [f"effect.{names[each]}.factor={size}" for each, size in factors.items()]
    return load("lab_n_b", settings=given).parameters


def draws() -> Floats:
    """Return deviations [draws, 1 + len(SD)] in standard deviations; the first is none."""
    near = norm.ppf(np.clip(qmc.Sobol(1 + len(SD), rng=3).random(64), 1e-3, 1 - 1e-3))[:NEAR]
    near[0] = 0.0
    corners = np.zeros((8, near.shape[1]))
    corners[[0, 1, 2, 3, 4], 0] = 4.5, -4.5, 0.0, 3.9, 3.0
    corners[[2, 3, 4], 1] = DEVIATIONS, 2.2, 3.0
    corners[5, 2] = 8.0  # valves exchanged and not yet learned
    corners[[6, 7], 3] = 4.0, -4.0
    slow, single = _directions(EXCHANGED, 3.2, 12), _directions(SINGLE, 3.2, 13)
    slow[:, 2] = 7.75
    far = _directions(FAR, DEVIATIONS, 3), _directions(PROOF, DEVIATIONS, 11)
    return np.concatenate([near, corners, *far, slow, single])


def _directions(count: int, length: float, seed: int) -> Floats:
    """Return draws [count, 1 + len(SD)] of a length, half of them towards a stall."""
    drawn = np.random.default_rng(seed).standard_normal((count, 1 + len(SD)))
    stalls = slice(count // 2)
    drawn[stalls, 0] = 0.4 + 1.4 * np.abs(drawn[stalls, 0])
    drawn[stalls, 1] = 1.2 * np.abs(drawn[stalls, 1])
    found: Floats = drawn * length / np.linalg.norm(drawn, axis=1, keepdims=True)
    return found


class Pushes(FamilyModel):
    """Plain pushes with delays [3, pushes] of the valves, s, and what programmes do in each of them."""

    def __init__(self, setups: Sequence[Setup], rise_s: Floats, fall_s: Floats) -> None:
        self._rise_s, self._fall_s = rise_s, fall_s
        super().__init__(varied(), Family("g", "unblock", (setups[0].conditions,)), 0.0, 0.0)
        self.loads = len(setups)
        self._base = Strokes.from_setups(setups, 1.0)
        self.limit_s = np.full(self.loads, 0.5)
        self.plain = self.under(NONE, range(self.loads))
        self.plain_m_s, self.plain_s = self.plain.cost_m_s[0], self.plain.revealed_s[0]

    def under(self, programmes: Floats, which: range | list[int]) -> Arrivals:
        """Return arrivals [n, which] of programmes [n, 2, 4]."""
        given = self.changes(LAYOUT, *stem_spans(programmes))
        repeated = [np.repeat(each, len(which), axis=0) for each in given]
        found = self._simulate(repeated, np.tile(np.array(which), len(programmes)))
        return found.reshaped((len(programmes), len(which)))

    def _simulate(self, given: list[Floats], load: Ints, hold_s: float = 0.05) -> Arrivals:
        self.valve_s = self._rise_s[:, load], self._fall_s[:, load]  # type: ignore[assignment]
        return super()._simulate(given, load, hold_s)


class Draws(Pushes):
    """The plain push under draws around one impulse, and what programmes do in each of them."""

    def __init__(
        self,
        strength: Strength,
        bar: float,
        close_s: float,
        impulse_n_s: float,
        sds: Mapping[str, float] = SD,
    ) -> None:
        small, large = strength.impulse
        sd = float(np.interp(impulse_n_s, (60.0, 110.0), (small, large)))
        z = draws()
        (heavier, more), (lighter, less) = strength.mesh, strength.lighter
        mesh = np.where(z[:, 1] > 0.0, heavier + more * z[:, 1], lighter + less * z[:, 1])
        changed = {name: sd_of * z[:, 1 + k] for k, (name, sd_of) in enumerate(sds.items())}
        setups = []
        for k in range(len(z)):
            factors = {each: round(float(np.exp(changed[each][k])), 2)
                       for each in ("friction", "inlet", "exhaust")}  # fmt: skip
            supply = float(np.clip(changed["supply"][k], -0.035, 0.035))
            case = replace(
                PUSH,
                supply_pressure_pa=1e5 * bar * (1.0 + supply),
                mounted=True,
                mesh_force_n=MESH_N * float(np.exp(mesh[k])),
                sync_impulse_n_s=impulse_n_s * float(np.exp(sd * z[k, 0])),
            )
            setups.append(make_setup(varied(**factors), case))
        self.impulse_n_s = impulse_n_s
        slower = np.ones((3, len(z)))
        slower[0, -SINGLE::2] = slower[1, 1 - SINGLE :: 2] = SLOWER
        rise_s, fall_s = (OPEN_S + changed["rise"], close_s + changed["fall"])
        super().__init__(setups, slower * rise_s, slower * fall_s)
        self.limit_s = self.plain.arrival_s[0] + EXTRA_S

    def costs(self, programmes: Floats, which: range | list[int]) -> Floats:
        """Return mean and worst impact [n] near what is expected, far more for an unsafe one."""
        impact_m_s = self.under(programmes, which).cost_m_s
        at = np.array(which)
        near = np.sort(impact_m_s[:, at < NEAR], axis=1)
        over = np.maximum(impact_m_s - self.plain_m_s[at] - HARDER_M_S, 0.0)
        worst = near[:, -max(1, near.shape[1] // 8) :].mean(axis=1)
        spans = (programmes[..., 1::2] > 0.0).sum(axis=(1, 2))
        early = ((programmes[..., 0::2] < FIRST) & (programmes[..., 1::2] > 0.0)).any(axis=(1, 2))
        unsafe = 10.0 * over.max(axis=1) + over.sum(axis=1) + early
        found: Floats = near.mean(axis=1) + 0.5 * worst + 0.004 * spans + unsafe
        return found

    def best(self, pool: Floats, rng: np.random.Generator) -> Floats:
        """Return programmes [6, 2, 4] of a pool with small changes: the best proven one, then the best.

        A draw in which a proof fails counts from then on.
        """
        few, some, every = [0, NEAR, NEAR + 3], SOME, list(range(NEAR + 8 + FAR))
        pool = np.unique(np.concatenate([pool, NONE]), axis=0)
        if len(pool) > 400:
            pool = pool[self.under(pool, [0]).cost_m_s[:, 0] <= self.plain_m_s[0]]
            pool = pool[np.argsort(self.costs(pool, few))[:400]]
        pool = np.concatenate([NONE, pool[np.argsort(self.costs(pool, some))[:BEST]]])
        costs = self.costs(pool, every)
        for turn in range(ROUNDS + PROOFS):
            at = int(np.argmin(costs))
            if turn >= ROUNDS:
                failed = self.failed(pool[at]) if costs[at] < costs[0] - 0.01 else []
                if not failed:
                    break
                every += failed
                costs += 10.0 * np.maximum(self.over(pool, failed), 0.0).sum(axis=1)
            if turn >= ROUNDS and turn % 3:
                continue
            parents = np.repeat(pool[np.argsort(costs)[:8]], 6, axis=0)
            children = np.unique([self.changed(each, rng) for each in parents], axis=0)
            children = children[np.argsort(self.costs(children, some))[:CHILDREN]]
            pool = np.concatenate([pool, children])
            costs = np.concatenate([costs, self.costs(children, every)])
        else:
            at = 0
        best = pool[np.argsort(costs, kind="stable")[:5]]
        found: Floats = np.concatenate([pool[[at if costs[at] < costs[0] - 0.01 else 0]], best])
        return found

    def over(self, programmes: Floats, which: range | list[int]) -> Floats:
        """Return by how much the impacts [n, which] exceed the limit of the proof, m/s."""
        limit_m_s = self.plain_m_s[np.array(which)] + HARDER_M_S + 0.01
        over: Floats = self.under(programmes, which).cost_m_s - limit_m_s
        return over

    def failed(self, programme: Floats) -> list[int]:
        """Return the draws of the proof in which a programme [2, 4] fails worst, three at most."""
        first = NEAR + 8 + FAR
        over = self.over(programme[None], range(first, self.loads))[0]
        return [first + int(at) for at in np.argsort(-over)[:3] if over[at] > 0.0]

    def changed(self, programme: Floats, rng: np.random.Generator) -> Floats:
        """Return a programme with one to three numbers changed."""
        made = programme.copy()
        for _ in range(rng.integers(1, 4)):
            valve, at = rng.integers(2), rng.integers(4)
            if at % 2 or made[valve, at + 1] > 0.0:
                made[valve, at] = max(made[valve, at] + rng.choice([-1.0, 1.0]), at % 2 - 1.0)
            elif rng.random() < 0.5:
                made[valve, at : at + 2] = rng.integers(1, int(100.0 * self.plain_s[0]) + 2), 4
        made[:, 0] += rng.choice([-1.0, 0.0, 0.0, 0.0, 1.0])
        return tidy(made)

    def line(self, programme: Floats) -> str:
        """Return release of the programme, its change by that of the plain push, and its spans."""
        released_s = self.under(programme[None], [0, NEAR, NEAR + 1]).revealed_s[0]
        rise_s = self.plain_s[NEAR] - self.plain_s[NEAR + 1]
        gain = float(np.clip((released_s[1] - released_s[2]) / rise_s, 0.7, 2.0))
        steps = ",".join(f"{step:.0f}" for step in programme.ravel())
        return f"{1e4 * released_s[0]:.0f},{gain:.2f},{steps}"


def grid(
    release_s: float,
    vents: Sequence[int] = (0, 4, 5, 6, 8),
    brakes: Sequence[int] = (0, 1, 2, 4, 7),
) -> Floats:
    """Return programmes [n, 2, 4] of one span of each valve, of these lengths, near the release."""
    at, made = int(100.0 * release_s), []
    for vent, vented, brake, braked in product(range(-9, 2), vents, range(-6, 4), brakes):
        if min(at + vent, at + brake) > 0 and vented + braked > 0:
            made.append([[at + vent, vented, 0, -1], [at + brake, braked, 0, -1]])
    return np.unique(tidy(np.array(made, dtype=float)), axis=0)


def tidy(programmes: Floats) -> Floats:
    """Return programmes [..., 2, 4] of which a span that is none is 0, -1, as is a start before 0."""
    made = programmes.copy()
    none = made[..., 1::2] <= 0.0
    made[..., 0::2] = np.where(none, 0.0, np.maximum(made[..., 0::2], 0.0))
    made[..., 1::2] = np.where(none, -1.0, made[..., 1::2])
    return made


Key = tuple[float, float, int]
"""Supply in bar, closing delay in ms, index of the impulse."""


def read(path: Path) -> dict[Key, Floats]:
    """Return the programmes [n, 2, 4] of all strengths by row; none if there is no such file."""
    found: dict[Key, Floats] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        if not line.startswith("#"):
            head, *lines = line.split(";")
            bar, close_ms, impulse_n_s, _ = map(float, head.split(","))
            n = int(np.argmin(np.abs(IMPULSES_N_S - impulse_n_s)))
            numbers = [each.split(",")[2:] for each in lines]
            found[bar, close_ms, n] = np.array(numbers, dtype=float).reshape(-1, 2, 4)
    return found


def search(strength: Strength, given: Mapping[Key, Floats]) -> dict[Key, tuple[float, str]]:
    """Return release under the plain push and line of each row, from given programmes near it."""
    rng = np.random.default_rng(0)
    known = dict(given)
    lines: dict[Key, tuple[float, str]] = {}
    for bar, close_ms, n in product(SUPPLY_BAR, CLOSE_MS, range(len(IMPULSES_N_S))):
        model = Draws(strength, bar, 1e-3 * close_ms, float(IMPULSES_N_S[n]))
        row = bar, close_ms, n
        near = [
            programmes
            for (p, c, m), programmes in known.items()
            if abs(p - bar) < 0.6 and abs(c - close_ms) < 5.0 and abs(m - n) < 3
        ]
        pool = np.unique(np.concatenate(near or [grid(float(model.plain_s[0]))]), axis=0)
        found = model.best(tidy(pool), rng)
        known[row] = np.concatenate([found, known.get(row, NONE)])
        lines[row] = float(model.plain_s[0]), model.line(found[0])
        print(strength.name, *row, lines[row][1], flush=True)
    return lines


def main(path: Path, workers: int) -> None:
    """Search all strengths, beginning with the programmes of the file if there is one; write it."""
    given = read(path)
    strengths = spread_out(lambda each: search(each, given), STRENGTHS, workers)
    text = [
        "# Made by python -m tests.bench._learned_programmes; each line: supply in bar, closing",
        "# delay in ms, impulse in N s, release of the plain push in 0.1 ms; for each strength:",
        "# release of its programme in 0.1 ms, change of that by the former, two spans of venting,",
        "# two of filling (start, steps; 0,-1: none)",
    ]
    for (bar, close_ms, n), (plain_s, _) in strengths[0].items():
        head = f"{bar:g},{close_ms:g},{IMPULSES_N_S[n]:.3f},{1e4 * plain_s:.0f}"
        text.append(";".join([head, *(lines[bar, close_ms, n][1] for lines in strengths)]))
    path.write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
