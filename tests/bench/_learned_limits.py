"""Which of the things that a unit does not know keeps its programmes from being softer.

python -m tests.bench._learned_limits [IMPULSE_N_S...]

At 9 bar and a closing delay of 35 ms, for each impulse: the programme that `_learned_programmes`
would take if some of what it has to bear were known to the last digit (`KNOWN`). Every case gets the
programmes that were found for the others as well, so that more knowledge is not made worse by the
search. Printed: mean impact of 20 draws, and the hardest.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sil.studies.policies import Floats
from tests.bench._learned_programmes import (
    FAR,
    NEAR,
    NONE,
    SD,
    Draws,
    Strength,
    grid,
    read,
    strong,
    tidy,
)

EXACT = 1e-6
STRONG = strong(0.0)
OTHERS = ("rise", "fall", "friction", "inlet", "exhaust", "supply")
IMPULSES = (40.0, 57.0, 83.0, 140.0, 230.0)
SEARCHES = 3
BAR, CLOSE_S = 9.0, 0.035
PROGRAMMES = Path(__file__).parents[2] / "controller" / "programmes.csv"


@dataclass(frozen=True)
class Known:
    """A case: standard deviation of impulse (small, large) and meshing force, and what is exact."""

    name: str
    impulse: tuple[float, float] = STRONG.impulse
    mesh: tuple[float, float] = STRONG.mesh
    lighter: tuple[float, float] = STRONG.lighter
    exact: tuple[str, ...] = field(default=())

    def draws(self, impulse_n_s: float) -> Draws:
        """Return the plain push and its draws with what is known in this case."""
        sds = {name: EXACT if name in self.exact else sd for name, sd in SD.items()}
        strength = Strength(self.name, self.impulse, self.mesh, self.lighter)
        return Draws(strength, BAR, CLOSE_S, impulse_n_s, sds)


NO_MESH, NO_IMPULSE = (0.0, EXACT), (EXACT, EXACT)
KNOWN = (
    Known("as the strong programmes"),
    Known("meshing force exact", mesh=NO_MESH, lighter=NO_MESH),
    Known("impulse exact", impulse=NO_IMPULSE),
    Known("delays exact", exact=("rise", "fall")),
    Known("friction, flows and supply exact", exact=OTHERS[2:]),
    Known("all exact but impulse", mesh=NO_MESH, lighter=NO_MESH, exact=OTHERS),
    Known("all exact but meshing force", NO_IMPULSE, exact=OTHERS),
    Known("all exact", NO_IMPULSE, NO_MESH, NO_MESH, OTHERS),
)


def softest(model: Draws, pool: Floats) -> tuple[float, Floats]:
    """Return cost and programme [2, 4] of the best of a pool [n, 2, 4] that no draw refuses."""
    costs = model.costs(pool, list(range(NEAR + 8 + FAR)))
    for at in np.argsort(costs):
        if not model.failed(pool[at]):
            return float(costs[at]), np.asarray(pool[at])
    raise AssertionError("the plain push, which is in every pool, cannot be refused")


def table(impulse_n_s: float) -> list[tuple[str, float, float]]:
    """Return mean and hardest impact, m/s, of each case."""
    models = [case.draws(impulse_n_s) for case in KNOWN]
    near = [
        programmes
        for (bar, close_ms, _), programmes in read(PROGRAMMES).items()
        if bar == BAR and close_ms == 1e3 * CLOSE_S
    ]
    pool = np.unique(np.concatenate([NONE, *near, grid(float(models[0].plain_s[0]))]), axis=0)
    found = [NONE]
    for seed in range(SEARCHES):
        for model in models:
            begun = tidy(np.concatenate([pool, *found]))
            found.append(model.best(begun, np.random.default_rng(seed)))
    known = np.unique(np.concatenate(found), axis=0)
    rows = []
    for case, model in zip(KNOWN, models, strict=True):
        _, programme = softest(model, known)
        impact_m_s = model.under(programme[None], range(NEAR)).cost_m_s[0]
        rows.append((case.name, float(impact_m_s.mean()), float(impact_m_s.max())))
    plain_m_s = models[0].plain_m_s[:NEAR]
    return [("plain push", float(plain_m_s.mean()), float(plain_m_s.max())), *rows]


def main(impulses: list[float]) -> None:
    """Print a column for each impulse."""
    columns = []
    for impulse_n_s in impulses:
        columns.append(table(impulse_n_s))
        for name, mean_m_s, hardest_m_s in columns[-1]:
            print(f"{impulse_n_s:.0f} N s  {name}: {mean_m_s:.2f}, {hardest_m_s:.2f}", flush=True)
    print("| known | " + " | ".join(f"{each:.0f} N s" for each in impulses) + " |")
    print("|---" * (1 + len(impulses)) + "|")
    for rows in zip(*columns, strict=True):
        cells = " | ".join(f"{mean:.2f} ({hardest:.2f})" for _, mean, hardest in rows)
        print(f"| {rows[0][0]} | {cells} |")


if __name__ == "__main__":
    main([float(each) for each in sys.argv[1:]] or list(IMPULSES))
