"""One run of a drawn scenario: which rules it broke, and which changes of state it made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.messages import ControllerStatus, ShiftState
from sil.recording.run_record import RunRecord
from sil.rules import Rule, Violation, violations
from sil.rules.reports import sent
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """What came of a scenario.

    refused: why it is no valid scenario. transitions: how often each change of state was reported.
    """

    refused: str = ""
    violations: list[Violation] = []
    transitions: dict[str, int] = {}


def attempt(table: Mapping[str, Any], rules: Sequence[Rule]) -> Attempt:
    """Run a scenario table and hold it to the rules."""
    try:
        loaded = from_table(table, "swarm")
        record = run_in_memory(loaded).record
    except InputError as error:
        return Attempt(refused=str(error))
    except RunError as error:
        return Attempt(violations=[Violation("runs_to_the_end", 0.0, str(error))])
    broken = violations(record, circumstances(loaded.scenario), rules)
    return Attempt(violations=broken, transitions=transitions(record))


def transitions(record: RunRecord) -> dict[str, int]:
    """Return how often the controller reported each change of state, by "FROM -> TO"."""
    states = [ShiftState.INIT, *(status.state for _, status in sent(record, ControllerStatus))]
    return Counter(f"{a.name} -> {b.name}" for a, b in pairwise(states) if a is not b)
