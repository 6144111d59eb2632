"""Search the tables of strategy learned: `controller/releases.csv` and `controller/programmes.csv`.

python -m tests.bench._learned_programmes FOLDER [WORKERS]

For each supply pressure and each release of the plain push: when to fill the neutral chamber, twice at
most. A filling begins in a step of 10 ms; its end is free, since a valve closes sooner after a short or
a reduced current, but is 25.5 ms at least after its command. A programme is judged by mean and hardest of all
impacts under `NEAR` draws of what the unit does not know (`Strength`, `SD`); in no key draw may it be
0.04 m/s harder or 28 ms later than the plain push in the same draw, and the probability to be so, by
`COUNT` draws 3.75 to 6 standard deviations away, weighted by how likely they are, must be below
`RISK`. Where none is found the push is left plain. Draws in which a candidate fails count in the search from
then on. A programme of FOLDER that passes all that is kept unless that of a nearby row is better here; rows
without one are searched more thoroughly.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import chi, norm, qmc

from plant.batch.batch import Strokes
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.diagnosis.workers import spread_out
from sil.shift_diagnosis.evolution import evolved
from sil.simulation.load_scenario import load
from sil.studies.policies import PUSH, Arrivals, Family, FamilyModel, Floats, Ints, Layout
from sil.studies.pulses import stem_spans

SUPPLY_BAR = (8.0, 8.33, 8.67, 9.0)
GROUPS = (9.0, 8.67), (8.0, 8.33)
"""Searched side by side; the second of each begins with the programmes of the first."""
IMPULSES_N_S = 14.0 * (290.0 / 14.0) ** (np.arange(-4, 52) / 45.0)
KEPT = range(4, 50)
"""Those of `controller/releases.csv`, 14 to 290 N s; draws deviate beyond."""
FIRST_S, STEP_S, PER_STEP = 0.07, 0.00125, 8
"""First release of the tables, from one row to the next, and rows in a step of the firmware."""
PERIOD = np.array([1.0, 10.0, 1.0, 10.0])
IMPULSE_LIMITS_N_S = 14.5, 305.0
EARLIEST = 2
"""First step of a programme: before, the speeds are not yet known."""
MESH_N = 1300.0
OPEN_S, DUMMY_S = 0.0083, 0.010
"""Opening delay of a valve at 50 degrees Celsius; a closing delay, by which ends are commanded here."""
SHORTEST_S = 0.0255
"""From the command of a filling to the earliest end: two steps, 4 ms for the plunger, and what current
is left of the filling before."""
EXTRA_S, HARDER_M_S = 0.028, 0.04
SD = {"rise": 0.0004, "end": 0.0005, "supply": 0.011, "friction": 0.07, "inlet": 0.01,
      "exhaust": 0.01}  # fmt: skip
"""Of trucks and shifts (sil/studies/shipped/learned.toml), and the tables' distance in pressure; in s or
relative. end: of a filling."""
SLOWER = 1.2
"""Delays of a neutral valve that is suddenly slow, by its own."""
LAYOUT = Layout("N", 2, 0)
NONE = np.full((1, 4), -1.0)
NEAR, KEYS, SLOW, COUNT = 20, 32, 6, 1400
NEAREST, FARTHEST, DEVIATIONS = 3.75, 6.0, 4.5
RISK = 3e-6
"""Probability beyond the limits, if the unit knows no more than it must, above which none is taken."""
WIDEST, PROOFS, SAMPLES, AGAIN = 60, 4, 14, 6
WORTH_M_S = 0.01
"""By how much a programme is better than the plain push at least."""
SPREAD = np.array([3.0, 20.0, 2.5, 20.0])
MESH, IMPULSE = (Parameters.fields[name].start for name in ("mesh_force", "sync_impulse"))


@dataclass(frozen=True)
class Strength:
    """What is known: the release of the plain push, to a relative sd of its impulse and one in s at most,
    and the meshing force, by its logarithm to that of `MESH_N` and its sd. twice: two fillings are allowed.
    """

    name: str
    impulse: float
    release_s: float
    heavier: float
    mesh: float
    twice: bool = True


STRENGTHS = (
    Strength("careful", 0.055, 0.0025, 0.03, 0.05),
    *(Strength(f"strong {level:.2f}", 0.05, 0.0016, level, 0.028)
      for level in (0.01, 0.055, 0.1, 0.145, 0.19)),
    Strength("late", 0.055, 0.0025, 0.03, 0.05, twice=False),
)  # fmt: skip
"""The order is that of `controller.programmes`."""


@cache
def varied(**factors: float) -> ParameterSet:
    """Return the parameters with friction and flows changed."""
    names = {"friction": "dynamic_friction", "inlet": "inlet_clog", "exhaust": "exhaust_clog"}
    given = [f"effect.{names[each]}.factor={size}" for each, size in factors.items()]
    return load("lab_n_b", settings=given).parameters


def draws() -> tuple[Floats, Floats]:
    """Return deviations [draws, 2 + len(SD)] in standard deviations, and the weight [COUNT] of the last ones.

    Columns: release, meshing force, then as `SD`. The first is none.
    """
    size = 2 + len(SD)
    near = norm.ppf(np.clip(qmc.Sobol(size, rng=3).random(32), 1e-3, 1.0 - 1e-3))[:NEAR]
    near[0] = 0.0
    rng = np.random.default_rng(5)
    keys = rng.standard_normal((KEYS, size))
    keys[: 2 * size] = np.concatenate([np.eye(size), -np.eye(size)])
    keys[2 * size : 2 * size + 4, :2] = (3.0, 3.0), (3.0, 1.5), (1.5, 3.0), (-3.0, 3.0)
    keys *= DEVIATIONS / np.linalg.norm(keys, axis=1, keepdims=True)
    slow = rng.standard_normal((SLOW, size))
    slow *= 2.5 / np.linalg.norm(slow, axis=1, keepdims=True)
    far = rng.standard_normal((COUNT, size))
    distance = rng.uniform(NEAREST, FARTHEST, COUNT)
    far *= (distance / np.linalg.norm(far, axis=1))[:, None]
    weight: Floats = chi.pdf(distance, size) * (FARTHEST - NEAREST) / COUNT
    return np.concatenate([near, keys, slow, far]), weight


DRAWN, WEIGHT = draws()
ALWAYS: Ints = np.arange(NEAR + KEYS + SLOW)
FEW: Ints = np.array([0, 1, 2, 3, NEAR, NEAR + 1, NEAR + 2, *range(NEAR + 16, NEAR + 24)])
FAR: Ints = np.arange(len(ALWAYS), len(DRAWN))


class Pushes(FamilyModel):
    """All draws under one supply pressure; `aim` gives them the impulses and the force of a row.

    release_s: [draws, impulses] of the plain push; nominal_s: [impulses] without deviations.
    """

    lanes = True
    tolerance = 1e-4
    spacing_s = STEP_S
    """From one row to the next: a release is expected up to half of it from the row that is taken."""

    def __init__(self, bar: float, drawn: Floats = DRAWN, weight: Floats = WEIGHT) -> None:
        self.drawn, self.weight = drawn, weight
        z = {name: drawn[:, 2 + k] * sd for k, (name, sd) in enumerate(SD.items())}
        setups = []
        for k in range(len(drawn)):
            factors = {each: round(float(np.exp(z[each][k])), 2)
                       for each in ("friction", "inlet", "exhaust")}  # fmt: skip
            case = replace(PUSH, supply_pressure_pa=1e5 * bar * float(np.exp(z["supply"][k])),
                           mounted=True, mesh_force_n=MESH_N, sync_impulse_n_s=60.0)  # fmt: skip
            setups.append(make_setup(varied(**factors), case))
        self._twice = True
        self._rise_s = np.tile(OPEN_S + z["rise"], (3, 1))
        self._fall_s = np.tile(DUMMY_S + z["end"], (3, 1))
        slow = slice(NEAR + KEYS, NEAR + KEYS + SLOW)
        self._rise_s[1, slow] *= SLOWER
        self._fall_s[1, slow] += (SLOWER - 1.0) * 0.02
        super().__init__(varied(), Family("g", "unblock", (setups[0].conditions,)), 0.0, 0.0)
        self.loads = len(setups)
        self._base = Strokes.from_setups(setups, 1.0)
        self._packed = self._base.packed.copy()
        self.limit_s = np.full(self.loads, 0.6)
        every: Ints = np.arange(self.loads)
        self.release_s = np.empty((self.loads, len(IMPULSES_N_S)))
        for k, impulse_n_s in enumerate(IMPULSES_N_S):
            self._give(np.full(self.loads, impulse_n_s), 0.0 * every)
            self.release_s[:, k] = self.under(NONE, every).revealed_s[0]
        self.nominal_s = self.release_s[0]

    def _give(self, impulse_n_s: Floats, heavier: Floats) -> None:
        packed = self._packed.copy()
        packed[:, IMPULSE] = impulse_n_s
        packed[:, MESH] = MESH_N * np.exp(heavier)
        self._base = replace(self._base, packed=packed)

    def _impulse_n_s(self, released_s: Floats) -> Floats:
        """Return the impulses [draws] with which the plain push of each draw is released at [draws]."""
        logs = np.log(IMPULSES_N_S)
        return np.array([np.exp(np.interp(at_s, own_s, logs))
                         for at_s, own_s in zip(released_s, self.release_s, strict=True)])  # fmt: skip

    def aim(self, strength: Strength, release_s: float) -> None:
        """Take what is known to a strength when the plain push is expected to be released at a time."""
        self._twice = strength.twice
        logs = np.log(IMPULSES_N_S)
        slope_s = float(np.interp(release_s, self.nominal_s, np.gradient(self.nominal_s, logs)))
        sd_s = np.hypot(
            min(strength.release_s, strength.impulse * slope_s), self.spacing_s / 12.0**0.5
        )
        self._give(
            self._impulse_n_s(release_s + sd_s * self.drawn[:, 0]),
            strength.heavier + strength.mesh * self.drawn[:, 1],
        )
        self.limit_s = np.full(self.loads, 0.6)
        plain = self.under(NONE, np.arange(self.loads))
        self.plain_m_s, self.limit_s = plain.cost_m_s[0], plain.arrival_s[0] + EXTRA_S
        self.plain_s = plain.revealed_s[0]

    def under(self, programmes: Floats, which: Ints) -> Arrivals:
        """Return arrivals [n, which] of programmes [n, 4]: twice first step and end in ms, -1 for none."""
        spans = np.full((len(programmes), 1, 4), -1.0)
        begin = programmes[:, 0::2]
        spans[:, 0, 0::2] = begin
        spans[:, 0, 1::2] = np.where(
            begin >= 0.0, 0.1 * programmes[:, 1::2] - 100.0 * DUMMY_S - begin, -1.0
        )
        given = self.changes(LAYOUT, *stem_spans(spans))
        repeated = [np.repeat(each, len(which), axis=0) for each in given]
        found = self._simulate(repeated, np.tile(which, len(programmes)))
        return found.reshaped((len(programmes), len(which)))

    def _simulate(self, given: list[Floats], load: Ints, hold_s: float = 0.05) -> Arrivals:
        self.valve_s = self._rise_s[:, load], self._fall_s[:, load]  # type: ignore[assignment]
        return super()._simulate(given, load, hold_s)

    def costs(self, programmes: Floats, which: Ints, near: int = NEAR) -> Floats:
        """Return mean and worst impact [n] near what is expected, far more for an unsafe one.

        near: so many of the draws, the first ones, are near.
        """
        impact_m_s = self.under(programmes, which).cost_m_s
        likely = np.sort(impact_m_s[:, :near], axis=1)
        over = np.maximum(impact_m_s - self.plain_m_s[which] - HARDER_M_S, 0.0)
        found: Floats = likely.mean(axis=1) + 0.3 * likely[:, -max(near // 8, 1) :].mean(axis=1)
        return found + 3.0 * over.max(axis=1) + 0.3 * over.sum(axis=1)

    def fails(self, programme: Floats, which: Ints = FAR) -> Ints:
        """Return those of some draws in which a programme [4] is beyond the limits."""
        cost_m_s = self.under(programme[None], which).cost_m_s[0]
        found: Ints = which[cost_m_s > self.plain_m_s[which] + HARDER_M_S]
        return found

    def risk(self, failed: Ints) -> float:
        """Return the probability of the far draws in which a programme is beyond the limits."""
        return float(self.weight[failed - FAR[0]].sum())

    def is_softer(self, programme: Floats, which: Ints) -> bool:
        """Return whether a programme [4] is worth more than the plain push, by its cost in some draws."""
        own, plain = self.costs(np.stack([programme, NONE[0]]), which)
        return bool(own < plain - WORTH_M_S)

    def is_safe(self, programme: Floats, failed: Ints) -> bool:
        """Return whether a programme [4] is within the limits, given the far draws in which it is not."""
        return self.risk(failed) <= RISK and not len(self.fails(programme, ALWAYS))

    def taken(self, pool: Floats, own: Floats) -> tuple[Floats, float]:
        """Return the best programme [4] of a pool and a safe one, `own`, that is safe, and its risk."""
        pool = np.concatenate([own[None], self._widest(pool)])
        pool = pool[np.argsort(self.costs(pool, ALWAYS), kind="stable")]
        for programme in pool[:PROOFS]:
            failed = self.fails(programme)
            if self.is_safe(programme, failed):
                return programme, self.risk(failed)
        return own, self.risk(self.fails(own))

    def _widest(self, pool: Floats) -> Floats:
        """Return the most promising of a pool [n, 4] and the plain push."""
        pool = np.unique(np.concatenate([NONE, tidy(pool)]), axis=0)
        if not self._twice:
            pool = pool[pool[:, 2] < 0.0]
        return pool[np.argsort(self.costs(pool, FEW, 4), kind="stable")][:WIDEST]

    def best(self, pool: Floats, hunts: int, turns: int) -> tuple[Floats, float]:
        """Return the best programme [4] near those of a pool that is not too risky, and its risk.

        hunts: from so many of the pool a search begins, and lasts so many turns.
        """
        which = ALWAYS
        pool = self._widest(pool)
        starts = alone(pool[np.argsort(self.costs(pool, which), kind="stable")], 1)[:hunts]
        for turn in range(PROOFS):
            found = [NONE[0], *starts]
            for start in starts:
                found.append(self._hunted(start, which, turns if turn == 0 else AGAIN))
            pool = np.unique(found, axis=0)
            pool = pool[np.argsort(self.costs(pool, which), kind="stable")]
            if not self.is_softer(pool[0], which):
                break
            failed = self.fails(pool[0])
            if self.is_safe(pool[0], failed):
                return pool[0], self.risk(failed)
            which = np.union1d(
                which, failed[np.argsort(np.linalg.norm(self.drawn[failed], axis=1))[:8]]
            )
            starts = pool[np.argsort(self.costs(pool, which), kind="stable")][:2]
        return NONE[0], 0.0

    def _hunted(self, start: Floats, which: Ints, turns: int) -> Floats:
        """Return the best programme [4] of a search from one; a filling that is none may appear."""
        at = 2 if start[2] >= 0.0 else 0
        before = start[at] - 6.0, 10.0 * start[at] - 30.0
        begin = np.where(start < 0.0, np.tile(before, 2), start) if self._twice else start
        return tidy(evolved(
            lambda points: self.costs(tidy(np.array(points)), which),
            begin,
            np.diag((SPREAD if self._twice else SPREAD * (1.0, 1.0, 0.0, 0.0)) ** 2),
            turns,
            SAMPLES,
        )[None])[0]  # fmt: skip

    def line(self, programme: Floats) -> str:
        """Return release of the programme, its change by that of the plain push, and its fillings."""
        at: Ints = np.array([0, NEAR, NEAR + 2 + len(SD)])
        released_s = self.under(programme[None], at).revealed_s[0]
        gain = (released_s[1] - released_s[2]) / (self.plain_s[at[1]] - self.plain_s[at[2]])
        numbers = ",".join(f"{k:.0f}" for k in programme * (1.0, 10.0, 1.0, 10.0))
        return f"{1e4 * released_s[0]:.0f},{float(np.clip(gain, 0.7, 2.0)):.2f},{numbers}"


def tidy(programmes: Floats) -> Floats:
    """Return programmes [n, 4] with fillings in their order, long enough, and apart."""
    made = programmes.copy()
    made[:, 0::2] = np.round(made[:, 0::2])
    none = (made[:, 0::2] < 0.0) | (made[:, 1::2] < 10.0 * made[:, 0::2] + 15.0)
    made[:, 0::2][none] = made[:, 1::2][none] = -1.0
    made[:, 0::2][~none] = np.maximum(made[:, 0::2][~none], EARLIEST)
    swap = (made[:, 2] >= 0.0) & ((made[:, 2] < made[:, 0]) | (made[:, 0] < 0.0))
    made[swap] = made[swap][:, [2, 3, 0, 1]]
    shortest = 10.0 * made[:, 0::2] + 1e3 * SHORTEST_S
    made[:, 1::2] = np.where(made[:, 0::2] >= 0.0, np.maximum(made[:, 1::2], shortest), -1.0)
    # the second one begins when the valve has closed
    two = (made[:, 0] >= 0.0) & (made[:, 2] >= 0.0)
    joined = two & (10.0 * made[:, 2] < made[:, 1])
    made[joined, 2] = np.ceil(0.1 * made[joined, 1])
    made[:, 3] = np.where(
        joined, np.maximum(made[:, 3], 10.0 * made[:, 2] + 1e3 * SHORTEST_S), made[:, 3]
    )
    found: Floats = np.round(made, 1) + 0.0
    return found


def alone(programmes: Floats, most: int) -> Floats:
    """Return programmes [n, 4], of those that begin in the same steps the first ones, so many at most."""
    count: dict[tuple[float, float], int] = {}
    chosen = []
    for each in programmes:
        key = float(each[0]), float(each[2])
        count[key] = count.get(key, 0) + 1
        chosen.append(count[key] <= most)
    found: Floats = programmes[np.array(chosen)]
    return found


def grid(release_s: float) -> Floats:
    """Return programmes [n, 4] near a release: a filling, and mostly a shorter one before it."""
    at, made = int(100.0 * release_s), []
    for second, before, length_ms in product(range(-4, 2), range(2, 11), (25.0, 32.0)):
        begin = at + second
        first = begin - before if before < 10 else -1
        if begin >= 0:
            last_ms = 10.0 * begin + 35.0
            made.append([first, 10.0 * first + length_ms if first >= 0 else -1.0, begin, last_ms])
    return tidy(np.array(made))


def rows_s(model: Pushes) -> Floats:
    """Return the releases of the rows under a supply pressure."""
    least_s, most_s = np.interp(np.log(IMPULSE_LIMITS_N_S), np.log(IMPULSES_N_S), model.nominal_s)
    first = np.ceil((least_s - FIRST_S) / STEP_S)
    return FIRST_S + STEP_S * np.arange(first, np.floor((most_s - FIRST_S) / STEP_S) + 1.0)


Key = tuple[float, int, int]
"""Supply in bar, number of the row, strength."""


def read(path: Path) -> dict[Key, Floats]:
    """Return the programmes [4] of a file; none if there is no such file."""
    found: dict[Key, Floats] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        if not line.startswith("#"):
            head, *lines = line.split(";")
            bar, plain = map(float, head.split(","))
            n = round((1e-4 * plain - FIRST_S) / STEP_S)
            for k, each in enumerate(lines):
                numbers = np.array(each.split(",")[2:], dtype=float)
                found[bar, n, k] = numbers * (1.0, 0.1, 1.0, 0.1)
    return found


def search(
    bars: tuple[float, ...], given: dict[Key, Floats]
) -> dict[float, tuple[Floats, dict[Key, str]]]:
    """Return releases of the plain push, and the lines of all rows, of some supply pressures."""
    known, made = dict(given), {}
    for bar in bars:
        model, lines = Pushes(bar), dict[Key, str]()
        for release_s, (k, strength) in product(rows_s(model), enumerate(STRENGTHS)):
            n = round((release_s - FIRST_S) / STEP_S)
            model.aim(strength, float(release_s))
            near = [
                programme + steps * PERIOD * (programme >= 0.0)
                for (p, m, j), programme in known.items()
                if abs(p - bar) < 0.4 and abs(j - k) < 3 and (programme >= 0.0).any()
                for steps in (round((n - m) / PER_STEP),)
                if abs(n - m - PER_STEP * steps) < 2 and abs(n - m) < 10
            ]
            own = tidy(given.get((bar, n, k), NONE[0])[None])[0]
            is_begun = (own >= 0.0).any() or ((bar, n, k) not in given and len(near) > 4)
            hunts = (2, 10) if is_begun else (5, 24)
            pool = np.concatenate([[own], grid(float(release_s)), np.array(near).reshape(-1, 4)])
            if model.is_softer(own, ALWAYS) and model.is_safe(own, model.fails(own)):
                found, likely = model.taken(pool, own)
            else:
                found, likely = model.best(pool, *hunts)
            known[bar, n, k], lines[bar, n, k] = found, model.line(found)
            mean_m_s = float(model.under(found[None], np.arange(NEAR)).cost_m_s.mean())
            print(f"{bar:g} {1e3 * release_s:.2f} {strength.name}: {lines[bar, n, k]}; {mean_m_s:.3f} "
                  f"for {model.plain_m_s[:NEAR].mean():.3f} m/s, {likely:.1e}", flush=True)  # fmt: skip
        made[bar] = model.nominal_s, lines
    return made


def main(folder: Path, workers: int) -> None:
    """Search all tables, beginning with the programmes of the folder if there are any; write them."""
    path = folder / "programmes.csv"
    given = read(path)
    found: dict[float, tuple[Floats, dict[Key, str]]] = {}
    for made in spread_out(lambda bars: search(bars, given), GROUPS, workers):
        found |= made
    text = [
        "# Made by python -m tests.bench._learned_programmes; each line: supply in bar, release of the",
        "# plain push in 0.1 ms; for each strength: release of its programme in 0.1 ms, change of that by",
        "# the former, and twice first step and end of filling the neutral chamber, in 0.1 ms (-1: none)",
    ]
    for bar in SUPPLY_BAR:
        lines = found[bar][1]
        for n in sorted({n for _, n, _ in lines}):
            head = f"{bar:g},{1e4 * (FIRST_S + STEP_S * n):.1f}"
            text.append(";".join([head, *(lines[bar, n, k] for k in range(len(STRENGTHS)))]))
    path.write_text("\n".join(text) + "\n")
    text = [
        "# Made by python -m tests.bench._learned_programmes; each line: impulse in N s, release of the",
        "# plain push in 0.1 ms under " + ", ".join(f"{bar:g}" for bar in SUPPLY_BAR) + " bar",
    ]
    for k in KEPT:
        times = ",".join(f"{1e4 * found[bar][0][k]:.1f}" for bar in SUPPLY_BAR)
        text.append(f"{IMPULSES_N_S[k]:.4f},{times}")
    (folder / "releases.csv").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
