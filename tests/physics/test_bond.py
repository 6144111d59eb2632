"""The contact of stay and piston as a choice: nut and collar that push only, or joined as in (3.63)."""

from __future__ import annotations

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import load as load_set
from plant.parameters import parse
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load

JOINED = "length.F_bond=1e6"


def shift(name: str, bond_n: float) -> Run:
    return run_in_memory(load(name, settings={"duration_s": 0.4, "length.F_bond": bond_n}))


@pytest.mark.parametrize(("name", "contact"), [("strategy_air_cushion", 0.013), ("lab_b_n", 0.0)])
def test_joined_bodies_stay_together_between_the_gears(name: str, contact: float) -> None:
    runs = [shift(name, bond) for bond in (0.0, 1e6)]
    apart = []
    for run in runs:
        truth = run.record.truth
        x = truth["position_m"]
        picked_up = np.flatnonzero(np.abs(x - x[0]) > 1e-4)[5:]
        between = picked_up[(x[picked_up] > 1e-4) & (x[picked_up] < 0.01275)]
        gap = truth["piston_1_m"] - truth["position_m"]
        apart.append(np.abs(gap[between] - contact).max())
        assert run.balances["closed"] and run.shifts[0].arrived_s is not None
    assert apart[1] < 1e-9 < 1e-5 < apart[0]


def test_a_weak_bond_breaks() -> None:
    """A bond that bears less than the brake pulls parts, later than none."""
    parted = []
    for bond in (0.0, 50.0, 1e6):
        events = shift("strategy_air_cushion", bond).record.events
        parted.append([e.time_s for e in events if e.name == "piston_1_separation"])
    assert parted[0][0] < parted[1][0] and not parted[2]


def test_in_the_truck_the_open_loop_hardly_depends_on_the_contact() -> None:
    found = [shift("truck_into_gear_2200n", bond) for bond in (0.0, 1e6)]
    push, joined = (run.shifts[0].impact_worst_m_s for run in found)
    assert push == pytest.approx(joined, abs=1e-5)


def test_a_full_set_may_leave_the_bond_out_but_nothing_else() -> None:
    nominal = load_set()
    raw: dict[str, dict[str, object]] = {}
    for path, item in nominal.entries.items():
        section, key = path.split(".")
        raw.setdefault(section, {})[key] = {
            "value": list(item.value) if isinstance(item.value, tuple) else item.value,
            "unit": item.unit,
            "source": item.source,
        }
    raw["length"].pop("F_bond")
    assert parse(raw, "older").value("length.F_bond") == 0.0
    raw["length"].pop("m_p")
    with pytest.raises(InputError, match=r"older: no length\.m_p"):
        parse(raw, "older")
