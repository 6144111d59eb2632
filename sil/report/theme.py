"""Colours of pictures and pages: Okabe and Ito's colour-blind-safe palette, on light and dark."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Theme:
    """The colours of one look; `chamber` maps B, N and F, `series` are for whatever has no role."""

    name: str
    paper: str
    ink: str
    faint: str
    grid: str
    band: str
    truth: str
    estimate: str
    alarm: str
    measured: str
    before: str
    after: str
    chamber: dict[str, str]
    state: dict[str, str]
    series: tuple[str, ...]

    def colour(self, role: str) -> str:
        """Return the colour of a role: a field, a chamber, a state, "series0" and so on, "#rrggbb".

        Raises KeyError for an unknown role.
        """
        return role if role.startswith("#") else self.roles()[role]

    def roles(self) -> dict[str, str]:
        """Return the colour of every role by name."""
        single = {name: value for name, value in vars(self).items() if isinstance(value, str)}
        numbered = {f"series{k}": colour for k, colour in enumerate(self.series)}
        return single | self.chamber | self.state | numbered


LIGHT = Theme(
    name="light",
    paper="#ffffff",
    ink="#1a1a1a",
    faint="#6b6b6b",
    grid="#e3e3e3",
    band="#f1f3f5",
    truth="#000000",
    estimate="#c2458f",
    alarm="#d55e00",
    measured="#8a9197",
    before="#d55e00",
    after="#0072b2",
    chamber={"B": "#0072b2", "N": "#009e73", "F": "#c98500"},
    state={
        "INIT": "#dddddd",
        "IDLE": "#eceff1",
        "PUSH": "#56b4e9",
        "CONFIRM": "#f0e442",
        "BLOW": "#8fd3bd",
        "HOLD": "#b3cde0",
        "VENT": "#e2cfe9",
        "FAULT": "#e8896b",
    },
    series=(
        *("#0072b2", "#d55e00", "#009e73", "#cc79a7"),
        *("#e69f00", "#56b4e9", "#000000", "#8c6d31"),
    ),
)

DARK = Theme(
    name="dark",
    paper="#14171a",
    ink="#eceff1",
    faint="#a0a7ad",
    grid="#2b3136",
    band="#1d2226",
    truth="#ffffff",
    estimate="#f08cc4",
    alarm="#ff8a4c",
    measured="#b9c0c6",
    before="#ff8a4c",
    after="#56b4e9",
    chamber={"B": "#56b4e9", "N": "#2cc79a", "F": "#f0b429"},
    state={
        "INIT": "#3a4046",
        "IDLE": "#262c31",
        "PUSH": "#1f6f9f",
        "CONFIRM": "#8a8000",
        "BLOW": "#1f7a5f",
        "HOLD": "#36566f",
        "VENT": "#5c4468",
        "FAULT": "#a3431f",
    },
    series=(
        *("#56b4e9", "#ff8a4c", "#2cc79a", "#f08cc4"),
        *("#f0b429", "#b5dcf5", "#ffffff", "#c9a66b"),
    ),
)
