"""What the extended model changes in the control loop: the shipped shifts run with it and without.

Checked by: tests/unit/sil/inference/campaign/test_consequence.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from can_dbc.errors import InputError, RunError
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load

SCENARIOS = ("lab_n_b", "lab_b_n", "lab_n_f", "lab_f_n", "oil_damper", "full_shift")


@dataclass(frozen=True)
class Change:
    """One shift of a scenario, with the given model and with the extended one.

    shift_time_s, impact_speed_m_s: (before, after), None where it never arrived or was never
    confirmed.
    """

    scenario: str
    shift: str
    shift_time_s: tuple[float | None, float | None]
    impact_speed_m_s: tuple[float | None, float | None]


@dataclass(frozen=True)
class Consequence:
    """Shifts before and after; or why a run cannot apply the extension."""

    shifts: tuple[Change, ...]
    refused: str = ""


def consequence(given: str, extended: Path) -> Consequence:
    """Run the shipped shifts with the given model and with the extended one.

    What belongs to instruments or to single strokes cannot be applied to a run; the reason is reported.
    """
    changes: list[Change] = []
    try:
        for name in SCENARIOS:
            before, after = (
                run_in_memory(load(name, model=str(model))).shifts for model in (given, extended)
            )
            changes += [
                Change(
                    name,
                    f"{one.from_gear} to {one.to_gear}",
                    (one.shift_time_s, two.shift_time_s),
                    (one.impact_speed_m_s, two.impact_speed_m_s),
                )
                for one, two in zip(before, after, strict=True)
            ]
    except InputError as error:
        return Consequence((), str(error).removeprefix(f"{extended}: "))
    except RunError as error:
        return Consequence(tuple(changes), f"{name} could not be run: {error}")
    return Consequence(tuple(changes))
