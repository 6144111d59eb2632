"""Which of the things that a unit does not know keeps its programmes from being softer.

python -m tests.bench._learned_limits [lasting] [IMPULSE_N_S...]

At 9 bar, for the release of the plain push with each impulse: the programme that `_learned_programmes`
would take (`STRONG`) if some of what it has to bear were known to the last digit (`EXACT`). The draws
then deviate by the other numbers alone; a valve that is suddenly slow stays among them. Two cases are of a unit
that knows all that lasts in its truck exactly, so that only the scatter between two shifts is left
(`LASTING`; with `lasting` these alone). One case has valves whose
closing delay is constant, so that a filling ends 35 ms after a step, 45 ms after it begins at least. Every case
gets the programmes that were found for the others as well, so that more knowledge is not made worse
by the search. Printed: mean impact of the near draws, and the hardest.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi

from sil.studies.policies import Arrivals, Floats, Ints
from tests.bench import _learned_programmes as tables
from tests.bench._learned_programmes import NONE, Pushes, grid, read

NUMBERS = ("release", "mesh", *tables.SD)
"""Columns of the draws."""
STRONG = tables.STRENGTHS[1]
EXACT: dict[str, tuple[str, ...]] = {
    "as the strong programmes": (),
    "meshing force exact": ("mesh",),
    "release exact": ("release",),
    "ends of fillings and opening delay exact": ("end", "rise"),
    "friction, flows and supply exact": ("friction", "inlet", "exhaust", "supply"),
    "all exact but the release": NUMBERS[1:],
    "all exact but the meshing force": ("release", *NUMBERS[2:]),
    "all exact": NUMBERS,
}
SCATTER = {
    "mesh": 0.02 / 0.028,
    "rise": 0.0002 / tables.SD["rise"],
    "end": 0.0002 / tables.SD["end"],
    "supply": 0.0027 / tables.SD["supply"],
    "friction": 0.05 / tables.SD["friction"],
    "inlet": 0.0,
    "exhaust": 0.0,
}
"""What is left of each number between two shifts (sil/studies/shipped/learned.toml; the supply by the
8 kPa in which it is reported), by what the strong programmes bear."""
LASTING: dict[str, tables.Strength] = {
    "all exact but the scatter between two shifts": replace(
        STRONG, impulse=0.021, release_s=0.0012
    ),
    "and the release known to 0.5 ms": replace(STRONG, impulse=0.021, release_s=0.0005),
}
"""Between two shifts the impulse scatters by 2 %, and its slow variation goes on by 0.4 %; of a larger
one the reports show the release to some 1.2 ms before a programme has to begin, to less while it goes on."""
CONSTANT, CLOSE_MS = "as the strong programmes, closing always after 35 ms", 35.0
IMPULSES = (24.0, 40.0, 60.0, 83.0, 140.0, 230.0)
BAR = 9.0
ROUNDS, HUNTS, TURNS = 2, 4, 24
"""Searches of each case, and the arguments of `Pushes.best`."""
PROGRAMMES = Path(__file__).parents[2] / "controller" / "programmes.csv"


def deviations(scale: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the draws of the tables with numbers that deviate by their scale, and the far ones' weights.

    scale: of some numbers, 1 for the others; 0: it does not deviate. The distance of a draw from what is
    expected has the density chi, with as many degrees of freedom as numbers are left. Key draws stay as
    far away; far ones begin where it is as unlikely as in the tables to be further, and end where theirs do.
    """
    by = np.array([scale.get(name, 1.0) for name in NUMBERS])
    left = by > 0.0
    drawn = np.where(left, tables.DRAWN, 0.0)
    freedom = max(int(left.sum()), 1)  # with no number left no draw deviates
    nearest = float(chi.isf(chi.sf(tables.NEAREST, len(NUMBERS)), freedom))
    share = np.linalg.norm(tables.DRAWN[tables.FAR], axis=1) - tables.NEAREST
    share /= tables.FARTHEST - tables.NEAREST
    far = nearest + (tables.FARTHEST - nearest) * share
    keys = np.arange(tables.NEAR, tables.NEAR + tables.KEYS)
    for rows, distance in ((keys, tables.DEVIATIONS), (tables.FAR, far)):
        length = np.linalg.norm(drawn[rows], axis=1)
        drawn[rows] *= (distance / np.where(length > 0.0, length, np.inf))[:, None]
    weight: Floats = chi.pdf(far, freedom) * (tables.FARTHEST - nearest) / tables.COUNT
    return drawn * by, weight


class Case(Pushes):
    """All draws at `BAR` in which some numbers deviate by a scale (`deviations`).

    constant: valves close a constant delay after their command ends, which it does in a whole step.
    strength: what is known of the release. spacing_s: of the rows of the table.
    """

    def __init__(
        self,
        scale: Mapping[str, float],
        constant: bool = False,
        strength: tables.Strength = STRONG,
        spacing_s: float = tables.STEP_S,
    ) -> None:
        self._constant, self.strength, self.spacing_s = constant, strength, spacing_s
        super().__init__(BAR, *deviations(scale))

    def under(self, programmes: Floats, which: Ints) -> Arrivals:
        """Return arrivals [n, which] of programmes [n, 4]."""
        made = programmes.copy()
        if self._constant:
            steps = np.round(0.1 * (made[:, 1::2] - CLOSE_MS))
            steps = np.maximum(steps, made[:, 0::2] + 1.0)
            made[:, 1::2] = np.where(made[:, 0::2] >= 0.0, 10.0 * steps + CLOSE_MS, -1.0)
        return super().under(made, which)

    def softest(self, pool: Floats) -> Floats:
        """Return the best programme [4] of a pool [n, 4] that is not too risky."""
        costs = self.costs(pool, tables.ALWAYS)
        for programme in pool[np.argsort(costs, kind="stable")]:
            if self.risk(self.fails(programme)) <= tables.RISK:
                return np.asarray(programme)
        raise AssertionError("the plain push, which is in every pool, is not risky")


def table(cases: list[Case], impulse_n_s: float) -> list[tuple[float, float]]:
    """Return mean and hardest impact, m/s, of the plain push and of each case."""
    logs = np.log(tables.IMPULSES_N_S)
    release_s = float(np.interp(np.log(impulse_n_s), logs, cases[0].nominal_s))
    row = (release_s - tables.FIRST_S) / tables.STEP_S
    near = [
        programme
        for (bar, n, _), programme in read(PROGRAMMES).items()
        if bar == BAR and abs(n - row) < tables.PER_STEP
    ]
    for case in cases:
        case.aim(case.strength, release_s)
    pool = np.concatenate([NONE, grid(release_s), np.array(near).reshape(-1, 4)])
    found = NONE
    for _ in range(ROUNDS):
        for case in cases:
            programme, _ = case.best(np.concatenate([found, pool]), HUNTS, TURNS)
            found = np.unique([*found, programme], axis=0)
    impacts_m_s = [cases[0].plain_m_s[: tables.NEAR]]
    for case in cases:
        programme = case.softest(found)
        impacts_m_s.append(case.under(programme[None], np.arange(tables.NEAR)).cost_m_s[0])
    return [(float(each.mean()), float(each.max())) for each in impacts_m_s]


def main(impulses: list[float], lasting: bool) -> None:
    """Print a column for each impulse. lasting: only the cases of a unit that knows its truck."""
    by_name = {name: Case(SCATTER, strength=each, spacing_s=0.0) for name, each in LASTING.items()}
    if not lasting:
        exact = {name: Case(dict.fromkeys(each, 0.0)) for name, each in EXACT.items()}
        by_name = {CONSTANT: Case({}, constant=True)} | exact | by_name
    names, columns = ["plain push", *by_name], []
    for impulse_n_s in impulses:
        columns.append(table(list(by_name.values()), impulse_n_s))
        for name, (mean_m_s, hardest_m_s) in zip(names, columns[-1], strict=True):
            print(f"{impulse_n_s:.0f} N s  {name}: {mean_m_s:.2f}, {hardest_m_s:.2f}", flush=True)
    print("| known | " + " | ".join(f"{each:.0f} N s" for each in impulses) + " |")
    print("|---" * (1 + len(impulses)) + "|")
    for name, *cells in zip(names, *columns, strict=True):
        texts = " | ".join(f"{mean:.2f} ({hardest:.2f})" for mean, hardest in cells)
        print(f"| {name} | {texts} |")


if __name__ == "__main__":
    given = sys.argv[1:]
    main([float(each) for each in given if each != "lasting"] or list(IMPULSES), "lasting" in given)
