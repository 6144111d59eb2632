"""Strokes of the plant alone: hardest impact, air, final volume, and the front of a design."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plant.effects.stroke_conditions import FULL_DUTY
from plant.parameters import load as load_parameters
from plant.systems.stroke import simulate
from sil.studies.figures import pareto_figure
from sil.studies.load_study import load_study
from sil.studies.policies import GEARBOX, PUSH, Commands, arrivals_of
from sil.studies.study import Study, StudyRow, Table

DESIGN = """
name = "s"
reads = ["impact_worst_m_s", "arrival_s"]
[stroke]
kind = "N-B"
commands = [[0.0, "B", 0.98], [0.025, "B", 0.0], [0.025, "N", 0.98], [0.04, "N", 0.0], [0.04, "B", 0.98]]
[design]
kind = "lhs"
samples = 8
[[sweep]]
path = "effect.exhaust_clog.factor"
low = 0.02
high = 1.0
scale = "log"
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "s.toml").write_text(DESIGN)
    return load_study(str(tmp_path / "s.toml"))


def table_of(study: Study, **texts: list[str]) -> Table:
    """The table of all rows, as it would be read back."""
    rows = [(row, study.run(row)) for row in study.rows()]
    numbers = {name: [result.figures[name] for _, result in rows] for name in study.file.columns()}
    for sweep in study.file.sweep:
        numbers[sweep.path] = [float(str(row.settings[sweep.path])) for row, _ in rows]
    return Table(texts, {name: np.array(values) for name, values in numbers.items()}, len(rows))


def test_a_stroke_counts_every_impact(study: Study) -> None:
    """A brake that comes too soon: the pistons hit harder than the stay."""
    figures = study.run(StudyRow(0, (), {"valve.D_fall": 0.005})).figures
    assert figures["impact_worst_m_s"] > 1.1 * figures["impact_speed_m_s"] > 0.0
    assert figures["air_used_kg"] > 1e-4


def test_the_final_volume_is_what_chamber_n_keeps_in_gear(study: Study) -> None:
    nominal, same, small = (
        study.run(StudyRow(0, (), {} if m3 is None else {"stroke.final_volume_m3": m3})).figures
        for m3 in (None, 2.8e-5, 2e-6)
    )
    assert same["impact_speed_m_s"] == pytest.approx(nominal["impact_speed_m_s"], abs=1e-4)
    assert small["passive_peak_pa"] > 1.2 * nominal["passive_peak_pa"]


def test_nothing_is_better_than_the_front_in_both(study: Study) -> None:
    dots, front = pareto_figure(study, table_of(study)).stacks[0].panels[0].series
    assert len(dots.x) == 8 and 1 <= len(front.x) <= 8
    assert (np.diff(front.x) >= 0.0).all() and (np.diff(front.y) < 0.0).all()
    for x, y in zip(dots.x, dots.y, strict=True):
        assert not ((x < front.x) & (y < front.y)).any()


def test_a_front_shows_the_unchanged_actuator_without_and_with_the_oil_damper(study: Study) -> None:
    plain, damped = study.file.draw(study, table_of(study))["pareto"].stacks[0].panels[0].notes
    assert (plain.text, damped.text) == ("nothing changed", "oil damper")
    assert plain.x == 1e3 * study.run(StudyRow(0, (), {})).figures["arrival_s"]
    assert damped.y < 0.5 * plain.y


def test_a_front_needs_no_reference_of_an_effect_with_more_parameters(tmp_path: Path) -> None:
    """Whose other parameters a choice states: nothing swept is the stroke without the effect."""
    bump = "effect.friction_bump."
    (tmp_path / "s.toml").write_text(
        DESIGN.replace("effect.exhaust_clog.factor", f"{bump}force_n").replace("0.02", "1.0")
        .replace("high = 1.0", "high = 50.0").replace("samples = 8", "samples = 2")
        + f'[[load]]\nname = "bump"\nset = {{ "{bump}position_m" = 0.006, "{bump}width_m" = 0.001 }}\n'
    )  # fmt: skip
    study = load_study(str(tmp_path / "s.toml"))
    table = table_of(study, load=["bump"] * 2)
    notes = study.file.draw(study, table)["pareto"].stacks[0].panels[0].notes
    assert [note.text for note in notes] == ["nothing changed", "oil damper"]


PARAMETERS = load_parameters("nominal")
BRAKED = (
    (0.0, "B", FULL_DUTY),
    (0.08, "N", FULL_DUTY),
    (0.09, "B", 0.0),
    (0.1, "B", FULL_DUTY),
    (0.11, "N", 0.0),
)


@pytest.mark.parametrize("commands", [PUSH.commands, BRAKED])
def test_each_arrival_is_that_of_the_stroke_that_the_plant_makes(commands: Commands) -> None:
    cases = [replace(case, commands=commands) for case in GEARBOX]
    arrivals = arrivals_of(PARAMETERS, cases)
    stroke = simulate(PARAMETERS, cases[2], np.array([0.0, 0.3]), internal=False)
    assert stroke.impact is not None
    revealed_s = next(event.time_s for event in stroke.events if event.name == "unblock")
    assert arrivals.arrival_s[2] == pytest.approx(stroke.impact.time_s, abs=2e-6)
    assert arrivals.revealed_s[2] == pytest.approx(revealed_s, abs=2e-6)
    assert arrivals.impact_worst_m_s[2] >= stroke.impact.speed_m_s * (1.0 - 1e-3)
    assert (np.diff(arrivals.revealed_s) > 0.0).all()


def test_a_late_arrival_has_no_impact() -> None:
    late = replace(PUSH, commands=((0.47, "B", FULL_DUTY),))
    assert np.isinf(arrivals_of(PARAMETERS, [late]).impact_worst_m_s).all()
