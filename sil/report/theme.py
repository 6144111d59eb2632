"""Colours of pictures and pages: Okabe and Ito's colour-blind-safe palette, on light and dark."""

from __future__ import annotations

_COLOURS = {
    "paper": ("#ffffff", "#14171a"),
    "ink": ("#1a1a1a", "#eceff1"),
    "faint": ("#6b6b6b", "#a0a7ad"),
    "grid": ("#e3e3e3", "#2b3136"),
    "band": ("#f1f3f5", "#1d2226"),
    "fault": ("#fbeee6", "#33241c"),
    "truth": ("#000000", "#ffffff"),
    "estimate": ("#c2458f", "#f08cc4"),
    "alarm": ("#d55e00", "#ff8a4c"),
    "measured": ("#8a9197", "#b9c0c6"),
    "before": ("#d55e00", "#ff8a4c"),
    "after": ("#0072b2", "#56b4e9"),
    "B": ("#0072b2", "#56b4e9"),
    "N": ("#009e73", "#2cc79a"),
    "F": ("#c98500", "#f0b429"),
    "INIT": ("#dddddd", "#3a4046"),
    "IDLE": ("#eceff1", "#262c31"),
    "PUSH": ("#56b4e9", "#1f6f9f"),
    "CONFIRM": ("#f0e442", "#8a8000"),
    "BLOW": ("#8fd3bd", "#1f7a5f"),
    "HOLD": ("#b3cde0", "#36566f"),
    "VENT": ("#e2cfe9", "#5c4468"),
    "FAULT": ("#e8896b", "#a3431f"),
}
"""Colour of each role on light and on dark paper; B, N, F: chambers; in capitals: states."""

_SERIES = {
    "light": "#0072b2 #d55e00 #009e73 #cc79a7 #e69f00 #56b4e9 #000000 #8c6d31",
    "dark": "#56b4e9 #ff8a4c #2cc79a #f08cc4 #f0b429 #b5dcf5 #ffffff #c9a66b",
}
SERIES = 8  # number of the roles series0, series1, ... for whatever has no other role


THEMES = {
    name: {role: colours[k] for role, colours in _COLOURS.items()}
    | {f"series{n}": colour for n, colour in enumerate(_SERIES[name].split())}
    for k, name in enumerate(("light", "dark"))
}
"""The colours of each look by their role; pictures have the light one."""


def colour_of(role: str) -> str:
    """Return the colour of a role in pictures; "#rrggbb" is its own. Raises KeyError for another."""
    return role if role.startswith("#") else THEMES["light"][role]
