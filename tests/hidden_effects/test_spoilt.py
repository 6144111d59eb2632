"""Clean campaigns spoilt by the recorder: found by the diagnosis itself, and not taken for a cause."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.campaign.campaign import load_campaign
from sil.inference.campaign.diagnosis import diagnose
from tests.hidden_effects.campaign import hide, write_campaign

Table = dict[str, np.ndarray]


def gauges(table: Table) -> list[str]:
    return [name for name in table if name.startswith("pressure_") and "oil" not in name]


def swapped(table: Table) -> None:
    one, two = gauges(table)[:2]
    table[one], table[two] = table[two], table[one]


def shifted(table: Table) -> None:
    for name, values in table.items():
        if name != "time_s" and not name.startswith("cmd_"):
            table[name] = np.concatenate([np.full(80, values[0]), values[:-80]])


def saturated(table: Table) -> None:
    for name in gauges(table):
        table[name] = np.minimum(table[name], 450000.0)


def without_gauges(table: Table) -> None:
    for name in [*gauges(table), "pressure_oil2_pa", "position_internal_m"]:
        table.pop(name, None)


def spoil(folder: Path, change: Callable[[Table], None]) -> Path:
    for path in sorted(folder.glob("stroke_*.csv")):
        header = path.read_text(encoding="ascii").splitlines()[0].split(",")
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        table = {name: rows[:, k] for k, name in enumerate(header)}
        change(table)
        text = ",".join(table)
        np.savetxt(
            path, np.column_stack(list(table.values())), "%.6f", ",", header=text, comments=""
        )
    return folder


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (swapped, "channels are swapped"),
        pytest.param(saturated, "saturated at 450000 Pa", marks=pytest.mark.slow),
    ],
)
def test_spoilt_records_are_found_and_are_no_cause(tmp_path, change, expected) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 61), 61, 4), change)
    found = diagnose(load_campaign(folder), load(), workers=1)
    texts = [str(item) for item in found.findings]
    for number in range(1, 5):
        assert any(f"stroke_{number:03d}.csv" in text and expected in text for text in texts), texts
    assert found.verdict.kind == "consistent", [c.evidence for c in found.causes]


def test_with_the_position_alone_nothing_is_claimed(tmp_path) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 62), 62, 3), without_gauges)
    found = diagnose(load_campaign(folder), load(), workers=1)
    assert found.verdict.kind == "consistent"


@pytest.mark.slow
def test_a_shift_of_all_records_is_a_cause_not_taken_off(tmp_path) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 61), 61, 4), shifted)
    found = diagnose(load_campaign(folder), load(), workers=1)
    assert found.verdict.kind != "consistent"
    assert not any("taken off" in str(item) for item in found.findings)
