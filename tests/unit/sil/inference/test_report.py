"""The sentence that a reader sees first."""

from __future__ import annotations

import pytest

from sil.cli.diagnose import print_causes
from sil.inference.report import Gain, Interval, ReportedCause, headline, seen_sentence


def cause(name: str, parameter: str, *values: float, unit: str, p: float = 0.98) -> ReportedCause:
    return ReportedCause(name, "some class", p, {parameter: Interval(*values, unit)}, "evidence")


LATE = cause("valve_open_delay", "delay_s", 0.005, 0.0044, 0.0056, unit="s")


@pytest.mark.parametrize(
    ("verdict", "causes", "expected"),
    [
        ("named", [LATE], "Valves open 5.0 ms late (4.4 to 5.6 ms)."),
        (
            "named",
            [cause("exhaust_clog", "factor", 0.75, 0.72, 0.78, unit="-")],
            "Exhaust flows are 25 % lower (22 to 28 %).",
        ),
        (
            "ambiguous",
            [LATE, cause("piston_leak", "cda_m2", 2e-7, 1.5e-7, 2.5e-7, unit="m^2")],
            "Valves open 5.0 ms late (4.4 to 5.6 ms); or air leaks past the piston through "
            "0.20 mm² (0.15 to 0.25 mm²).",
        ),
        (
            "unnamed",
            [ReportedCause("unnamed", "flow", 0.9, {}, "", what="the exhaust flow of chamber N")],
            "Something is wrong: the exhaust flow of chamber N; no cause of the catalogue fits.",
        ),
    ],
)
def test_a_cause_is_said_with_its_size(
    verdict: str, causes: list[ReportedCause], expected: str
) -> None:
    assert headline(verdict, causes, "", "") == expected


def test_a_consistent_unit_says_what_would_have_been_seen() -> None:
    sizes = [
        ("dynamic_friction", 1.09, 1.0, "-"),
        ("stribeck", 0.3, 0.0, "m/s"),
        ("valve_open_delay", 0.0012, 0.0, "s"),
        ("piston_leak", 2e-7, 0.0, "m^2"),
    ]
    assert headline("consistent", [], seen_sentence(sizes), "") == (
        "Nothing found. A leak above 0.20 mm², a delay above 1.2 ms, friction above +9.0 % would "
        "have been seen."
    )
    assert (
        headline("cannot_tell", [], "", "too few strokes")
        == "These data cannot tell: too few strokes."
    )


def test_what_is_explained_is_said_in_the_units_of_the_measurement() -> None:
    channels = {"pressure_1_pa": (3e3, 2e3, 2e3), "position_m": (1.9e-3, 2e-5, 2e-5)}
    text = str(Gain((), channels, 70.0, 1.0))
    assert text == "rms of position from 1.9 mm to 0.02 mm, of which noise is 0.02 mm"
    rotary = Gain((), {"torque_n_m": (1.0, 0.5, 0.5)}, 2.0, 1.0)
    assert str(rotary) == "rms of torque from 1 N m to 0.5 N m, of which noise is 0.5 N m"


def test_the_command_says_what_how_sure_what_it_explains_and_what_next(capsys) -> None:
    evidence = "it gains 1.2e+13 in log evidence"
    print_causes(
        {
            "campaign": "measured",
            "verdict": "named",
            "headline": "Valves open 5.0 ms late (4.4 to 5.6 ms).",
            "causes": [{**LATE.as_json(), "evidence": evidence}],
            "explains": "rms of position from 1.9 mm to 0.02 mm, of which noise is 0.02 mm",
            "next_experiment": None,
            "extended_model": "extended_model.toml",
        }
    )
    assert capsys.readouterr().out.splitlines() == [
        "measured: named",
        "  Valves open 5.0 ms late (4.4 to 5.6 ms).",
        "  probability of valve_open_delay (some class): 0.98",
        "  Explains: rms of position from 1.9 mm to 0.02 mm, of which noise is 0.02 mm, on strokes "
        "that were not used for the fit",
        "  Next: run the control loop with extended_model.toml to see what it changes",
    ]
