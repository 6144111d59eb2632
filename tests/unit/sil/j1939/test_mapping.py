"""Mapping files: which frames they find, the values they give, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError
from sil.j1939.mapping import ANY_SOURCE, LAYOUT, SHIPPED, SignalMapping

DBC = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Shafts: 8 X
 SG_ Out : 7|16@0+ (0.5,0) [0|0] "rpm" X
 SG_ In : 16|16@1- (1,0) [-1000|1000] "rpm" X
BO_ 2566844675 Proprietary: 2 X
 SG_ Gear : 0|8@1+ (1,-125) [0|0] "" X
BO_ 2565867262 AnySender: 8 X
 SG_ Pressure : 0|8@1+ (8,0) [0|0] "kPa" X
 SG_ Real : 32|32@1- (1,0) [0|0] "" X
SIG_VALTYPE_ 2565867262 Real : 1;
"""


def mapping(tmp_path: Path, *rows: tuple[str, str, str, str]) -> SignalMapping:
    """A mapping of rows (meaning, message, signal, further keys) to the DBC above."""
    text = "".join(
        f'[[signal]]\nmeaning = "{meaning}"\nmessage = "{message}"\nsignal = "{signal}"\n{more}\n'
        for meaning, message, signal, more in rows
    )
    (tmp_path / "map.toml").write_text(text)
    (tmp_path / "layout.dbc").write_text(DBC)
    return SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "layout.dbc"))


def values(found: SignalMapping, can_id: int, data: str, extended: bool = True) -> dict[str, float]:
    sender = found.sender("", can_id, extended)
    assert sender is not None
    read = found.values(sender, bytes.fromhex(data))
    return {found.rows[k].meaning: value for k, value in read.items()}


def test_the_shipped_mapping_reads_the_standard() -> None:
    found = SignalMapping()
    assert found.is_standard
    etc1 = values(found, 0x0CF00203, "DC401F FF FF 803E 03".replace(" ", ""))
    assert etc1 == pytest.approx(
        {
            "shift_in_process": 1.0,
            "output_shaft_rad_s": 104.71975512,
            "input_shaft_rad_s": 209.4395102,
        }
    )
    assert values(found, 0x18F00503, "81FFFF7EFFFFFFFF") == {"selected_gear": 4, "current_gear": 1}
    assert values(found, 0x18F00503, "FBFFFF00FFFFFFFF") == {
        "selected_gear": 126,
        "current_gear": -125,
    }
    engine = values(found, 0x0CF00400, "FFFFAF40 1F FFFFFF".replace(" ", ""))
    assert engine == pytest.approx({"engine_torque_share": 0.5, "engine_rad_s": 104.71975512})
    assert values(found, 0x18FEAE30, "69FFFFFFFFFFFFFF") == {"supply_pressure_pa": 941325.0}


@pytest.mark.parametrize("data", ["FF" * 8, "FE" * 8])
@pytest.mark.parametrize("can_id", [0x0CF00203, 0x18F00503, 0x0CF00400, 0x18FEAE30])
def test_not_available_and_error_are_no_values(can_id: int, data: str) -> None:
    assert values(SignalMapping(), can_id, data) == {}


def test_the_largest_speed_is_valid_and_the_next_is_none() -> None:
    found = values(SignalMapping(), 0x0CF00203, "EFFFFAFFFF00FBFF")
    assert found == {"output_shaft_rad_s": pytest.approx(841.096, abs=0.001)}


def test_frames_are_found_whatever_priority_and_source() -> None:
    found = SignalMapping()
    for priority in range(8):
        for source in (0, 3, 0x85, 0xFD):
            can_id = priority << 26 | 61442 << 8 | source
            assert found.sender("b", can_id, True) == ("ETC1", "b", source)
    assert found.sender("b", 0x203, False) is None
    assert found.sender("b", 0x0DF00203, True) is None  # the same group in another data page


def test_other_layouts_with_their_own_numbers(tmp_path: Path) -> None:
    found = mapping(
        tmp_path,
        ("output_shaft_rad_s", "Shafts", "Out", "scale = 2.0\noffset = 1.0"),
        ("input_shaft_rad_s", "Shafts", "In", ""),
        ("current_gear", "Proprietary", "Gear", ""),
        ("supply_pressure_pa", "AnySender", "Pressure", "scale = 1000\nsource = 7"),
        ("engine_rad_s", "AnySender", "Real", ""),
    )
    assert not found.is_standard
    assert values(found, 0x100, "0102FFFF00000000", extended=False) == {
        "output_shaft_rad_s": 2.0 * 0.5 * 0x0102 + 1.0,
        "input_shaft_rad_s": -1.0,
    }
    assert values(found, 0x100, "FFFF007000000000", extended=False) == {
        "output_shaft_rad_s": 65536.0  # no J1939 message, so no value means "not available"
    }
    shafts = found.sender("", 0x100, False)
    assert shafts is not None and shafts.source == ANY_SOURCE
    assert values(found, 0x04FEF103, "7E00")["current_gear"] == 1.0  # another priority
    assert found.sender("", 0x18FEF104, True) is None  # another source
    assert values(found, 0x18F00607, "0A000000 0000C03F".replace(" ", "")) == {
        "supply_pressure_pa": 80_000.0,
        "engine_rad_s": 1.5,
    }
    assert values(found, 0x18F00608, "0A0000000000C03F") == {"engine_rad_s": 1.5}


GOOD = 'meaning = "current_gear"\nmessage = "ETC2"\nsignal = "TransCurrentGear"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "map.toml: signal: missing"),
        ("signal = []", "map.toml: signal: [] is wrong"),
        (
            "[[signal]]\n" + GOOD.replace("ETC2", "ECT2"),
            "signal[0].message: 'ECT2' is unknown; expected one of",
        ),
        (
            "[[signal]]\n" + GOOD.replace("TransCurrentGear", "CurrentGear"),
            "one of TransCurrentGear",
        ),
        (
            "[[signal]]\n" + GOOD.replace("current_gear", "gear"),
            "signal[0].meaning: 'gear' is unknown",
        ),
        ("[[signal]]\n" + GOOD + "scale = 0", "signal[0].scale: 0 makes"),
        ("[[signal]]\n" + GOOD + "scale = nan", "signal[0].scale: nan is wrong"),
        ("[[signal]]\n" + GOOD + 'scale = "1"', "signal[0].scale: '1' is wrong"),
        ("[[signal]]\n" + GOOD + "source = 254", "signal[0].source: 254 is wrong"),
        ("[[signal]]\n" + GOOD + "factor = 2", "signal[0].factor: unknown"),
        (
            "[[signal]]\n" + GOOD + "[gearbox]\nrange_ratio = 0.5",
            "gearbox.range_ratio: 0.5 is wrong",
        ),
        ("[[signal]\n", "map.toml:"),
    ],
)
def test_a_wrong_mapping_is_one_line(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError) as raised:
        SignalMapping(str(tmp_path / "map.toml"))
    assert expected in str(raised.value) and "\n" not in str(raised.value)
    assert "map.toml" in str(raised.value)


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"path": "missing.toml"}, "missing.toml"),
        ({"path": str(SHIPPED), "dbc": "missing.dbc"}, "missing.dbc"),
        ({"path": str(LAYOUT)}, "j1939.dbc"),
        ({"dbc": str(SHIPPED)}, "j1939.toml"),
    ],
)
def test_a_wrong_file_is_named(keywords: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        SignalMapping(**keywords)


def test_a_message_of_several_frames_is_refused(tmp_path: Path) -> None:
    long = DBC + '\nBO_ 2566844926 Long: 70 X\n SG_ Gear : 0|8@1+ (1,0) [0|0] "" X\n'
    (tmp_path / "long.dbc").write_text(long)
    (tmp_path / "map.toml").write_text(
        '[[signal]]\nmeaning = "current_gear"\nmessage = "Long"\nsignal = "Gear"\n'
    )
    with pytest.raises(InputError, match="Long has 70 bytes; expected one frame"):
        SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "long.dbc"))
