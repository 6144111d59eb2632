"""Which campaign number holds what: kind of case, effects and level, drawn from the number alone."""

from __future__ import annotations

import numpy as np

from tests.hidden_effects import effects
from tests.hidden_effects.campaign import Hidden, hide

CASES = ("none", "one", "two", "foreign", "small")
SHARES = (0.25, 0.40, 0.12, 0.15, 0.08)
SEED = 2007


def drawn(number: int) -> tuple[str, Hidden]:
    """Kind of case and what is hidden in the campaign of that number."""
    rng = np.random.default_rng([SEED, number])
    case = str(rng.choice(CASES, p=SHARES))
    level = "small" if case == "small" else str(rng.choice(("easy", "medium")))
    named = list(effects.SIZES)
    if case == "none":
        names: tuple[str, ...] = ()
    elif case == "foreign":
        names = (str(rng.choice(list(effects.FOREIGN))),)
    elif case == "two":
        first = str(rng.choice(named))
        others = [n for n in named if effects.SIZES[n][0] != effects.SIZES[first][0]]
        names = (first, str(rng.choice(others)))
    else:
        names = (str(rng.choice(named)),)
    return case, hide(names, level, number + SEED)
