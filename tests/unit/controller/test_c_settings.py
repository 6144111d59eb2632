"""The settings as one struct in C: every setting once, in the order of its bytes."""

from __future__ import annotations

import re
import struct

import pytest

from controller.c_settings import content, declaration
from controller.config import FirmwareConfig, load_config
from controller.filters import butterworth


def members() -> list[str]:
    """The names of all members, with the structs that they are in."""
    inside: list[str] = []
    names: list[str] = []
    for line in declaration().partition("struct opc4_settings {\n")[2].splitlines():
        if line.endswith("struct {"):
            inside.append("")
        elif end := re.match(r" +\} (\w+);", line):
            inside.pop()
            names = [name.replace("?", f"{end[1]}.", 1) if "?" in name else name for name in names]
        elif member := re.match(r" +(?:double|int64_t) (\w+)((?:\[\d\])*);", line):
            count = eval(member[2].replace("][", "*").strip("[]") or "1")
            names += ["?" * len(inside) + member[1]] * count
    return names


@pytest.mark.parametrize(
    ("table", "member", "value"),
    [
        ({"period_s": 0.005}, "period_s", 0.005),
        ({"filter": False}, "filter.enabled", 0),
        ({"sensor": {"still_ticks": 7}}, "sensor.still_ticks", 7),
        ({"blow": {"cut": "confirmation"}}, "blow.cut", 2),
        ({"broadcast": {"gear_forward": -3}}, "broadcast.gear_forward", -3),
        ({"strategy": "sliding_mode", "strategy_parameters": {"band_m_s": 0.3}},
         "sliding_mode.band_m_s", 0.3),
    ],
)  # fmt: skip
def test_a_setting_changes_its_own_bytes_alone(table: dict, member: str, value: float) -> None:
    config = load_config(table, "test")
    before, after = content(FirmwareConfig()), content(config)
    assert len(after) == 8 * len(members())
    changed = {
        k for k in range(len(members())) if before[8 * k : 8 * k + 8] != after[8 * k : 8 * k + 8]
    }
    k = members().index(member)
    kind = "d" if isinstance(value, float) else "q"
    assert struct.unpack_from(f"<{kind}", after, 8 * k)[0] == value
    assert changed - {members().index("strategy")} == {k}


def test_the_filter_comes_as_its_coefficients() -> None:
    numbers = [x for section in butterworth(6, 22.0, 100.0) for x in section]
    at = 8 * members().index("section_count")
    assert struct.unpack_from("<q15d", content(FirmwareConfig()), at) == (3, *numbers)
