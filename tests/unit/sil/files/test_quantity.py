"""Values in words: units from names, few digits, but never two equal numbers that differ."""

from __future__ import annotations

from typing import Any

import pytest

from sil.files.quantity import comparison, counted, quantity, unit_of


@pytest.mark.parametrize(
    ("name", "value", "limit", "text"),
    [
        ("position_lag_90_s", 0.012760103618673246, {"min": 0.038, "max": 0.046},
         "position_lag_90_s: 12.76 ms, expected 38 ms to 46 ms"),
        ("air_used_kg", 0.00081234, {"max": 0.0007}, "air_used_kg: 0.8123 g, expected at most 0.7 g"),
        ("frames", 1, {"min": 400}, "frames: 1, expected at least 400"),
        ("shift 1: requested to arrived", None, {"max": 0.2},
         "shift 1: requested to arrived: none, expected at most 0.2"),
        ("faults reported", ["A"], [], "faults reported: A, expected none"),
        ("valves off at the end", False, True, "valves off at the end: no, expected yes"),
        ("shift_time_s", 0.05000001, {"max": 0.05},
         "shift_time_s: 50.00001 ms, expected at most 50 ms"),
        ("valve_switchings", 3, {"min": 2, "max": 2}, "valve_switchings: 3, expected 2"),
    ],
)  # fmt: skip
def test_a_check_in_words(name: str, value: Any, limit: Any, text: str) -> None:
    assert comparison(name, value, limit, unit_of(name)) == text


def test_units_follow_from_names() -> None:
    assert [unit_of(n) for n in ("impulse_n_s", "speed_m_s", "late_m_s2", "duty", "delay_s")] == [
        "N s", "m/s", "m/s²", "", "s",
    ]  # fmt: skip
    assert [unit_of(n) for n in ("supply_fill_pa_s", "drag_n_m", "supply_v", "resistance_ohm")] == [
        "Pa/s", "N m", "V", "Ω",
    ]  # fmt: skip
    assert quantity(26_312.0, "N") == "26312 N"
    assert quantity(900_000.0, "Pa") == "9 bar" and quantity(2.0, "s") == "2 s"


@pytest.mark.parametrize(("count", "text"), [(0, "0 shifts"), (1, "1 shift"), (2, "2 shifts")])
def test_a_noun_follows_its_number(count: int, text: str) -> None:
    assert counted(count, "shift") == text
