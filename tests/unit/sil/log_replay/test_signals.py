"""Tolerances and the ignore list; the file they are in; values as text."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.codec import encode
from can_dbc.errors import InputError
from can_dbc.messages import ControllerStatus, Fault, Gear, ShiftState
from sil.log_replay.signals import Options, SignalComparer, load_options, same, value_text, values


def status(estimate_m: float, state: ShiftState = ShiftState.IDLE) -> tuple[object, ...]:
    message = ControllerStatus(state, Gear.NEUTRAL, estimate_m, Fault.NONE)
    found = values(ControllerStatus, encode(message).data)
    assert found is not None
    return found


def test_numbers_are_the_same_within_their_tolerance_only() -> None:
    assert same(1.0, 1.0, 0.0) and not same(1.0, 1.0 + 1e-12, 0.0)
    assert same(0.3, 0.1 + 0.2, 1e-9) and same(1.0, 1.5, 0.5) and not same(1.0, 1.51, 0.5)
    assert not same(None, 1.0, 10.0) and same(None, None, 0.0)


def test_ignored_and_tolerated_signals_do_not_differ() -> None:
    ours, theirs = status(0.001), status(0.002, ShiftState.PUSH)
    names = [
        name for _, name in SignalComparer(Options()).differing(ControllerStatus, ours, theirs)
    ]
    assert names == ["ControllerStatus.state", "ControllerStatus.estimate_m"]
    some = SignalComparer(Options(ignore=["*.estimate_m"]))
    assert [n for _, n in some.differing(ControllerStatus, ours, theirs)] == [
        "ControllerStatus.state"
    ]
    lenient = Options(ignore=["*.state"], tolerance={"ControllerStatus.estimate_m": 0.001})
    assert SignalComparer(lenient).differing(ControllerStatus, ours, theirs) == []


def test_values_outside_the_contract_are_none() -> None:
    assert values(ControllerStatus, bytes(8)) is None  # unused bits are ones


def test_options_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "o.toml"
    file.write_text(
        'ignore = ["Etc1.*"]\ntime_s = 0.01\n[tolerance]\n"ControllerStatus.estimate_m" = 1e-5\n'
        "[edges]\nwindow_s = 0.1\n"
    )
    options = load_options(file)
    assert options.time_s == 0.01 and options.edges.window_s == 0.1


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('ignore = ["Etc9.*"]', "ignore: Etc9"),
        ('ignored = ["Etc1.*"]', "ignored: unknown"),
        (
            '[tolerance]\n"ControllerStatus.estimat_m" = 1.0',
            "expected one of ControllerStatus.estimate_m",
        ),
        ('[tolerance]\n"ControllerStatus.estimate_m" = -1.0', "tolerance"),
        ('[tolerance]\n"ControllerStatus.estimate_m" = nan', "finite"),
        ("time_s = 'x'", "time_s"),
        ("[edges", "expected TOML"),
    ],
)
def test_options_that_are_none_are_refused_by_name(
    tmp_path: Path, text: str, complaint: str
) -> None:
    file = tmp_path / "o.toml"
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        load_options(file)
    assert complaint in str(refused.value) and str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_values_as_a_reader_wants_them() -> None:
    assert value_text(Fault.NONE) == "NONE"
    assert value_text(Fault.POSITION_LOST | Fault.SPEEDS_LOST) == "POSITION_LOST|SPEEDS_LOST"
    assert (value_text(None), value_text(True), value_text(0.98), value_text(Gear.FORWARD)) == (
        "not available",
        "yes",
        "0.98",
        "FORWARD",
    )
