"""Weighing of assumptions: designs, indices of a function with known ones, one row, one turn of a sign."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import ParameterSet, load
from sil.cli import main
from sil.report.figure import Floats
from sil.studies.assumptions import FACTORS, NOT_VARIED
from sil.studies.design import Design, SweptValue, drawn_shares
from sil.studies.kinds.headlines import shipped_headlines
from sil.studies.kinds.sensitivity import holds, in_words, total_indices
from sil.studies.load_study import load_study
from sil.studies.study import Study, StudyRow, Table
from sil.studies.table import quantiles, share_interval

HEADLINES = [headline.name for headline in shipped_headlines()]


def test_a_radial_design_changes_one_value_at_a_time() -> None:
    points = drawn_shares(Design(kind="radial", samples=8, seed=3), 4).reshape(8, 5, 4)
    for block in points:
        changed = [np.flatnonzero(row != block[0]).tolist() for row in block[1:]]
        assert changed == [[k] for k in range(4)]


def test_total_indices_of_the_ishigami_function() -> None:
    """Known: 0.558, 0.442, 0.244; the first and third act together."""
    x, y, z = (2.0 * math.pi * drawn_shares(Design(kind="radial", samples=8192), 3) - math.pi).T
    indices = total_indices(np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x), 3)
    for (index, low, high), exact in zip(indices, (0.558, 0.442, 0.244), strict=True):
        assert low <= index <= high and abs(index - exact) < 0.05
        assert high - low < 0.2
    assert total_indices(x, 3)[1:, 0].tolist() == [0.0, 0.0]


def test_where_a_headline_holds() -> None:
    x = np.array([3.0, 1.0, 2.0, 4.0])
    assert holds(x, np.ones(4)) == "always"
    assert holds(x, -np.ones(4)) == "never"
    assert holds(x, np.array([-1.0, 1.0, 1.0, 1.0])) == "1 to 2, 4"


def test_one_at_a_time_begins_with_the_model_as_it_is() -> None:
    study = load_study("sensitivity")
    first, *others = study.rows()
    assert all(sweep.values and first.settings[sweep.path] == sweep.values[0] for sweep in study.file.sweep)  # fmt: skip
    for row in others:
        changed = [path for path, value in row.settings.items() if value != first.settings[path]]
        assert len(changed) == 1
    radial = load_study("sensitivity_global")
    assert radial.size == 40 * 10
    only = {*study.file.columns()} - {*radial.file.columns()}
    assert only == {"often_ahead_m_s", "often_damper_m_s"}


BY_CONDITION = {
    "stroke.supply_pressure_pa": {"supply.P_s"},
    "stroke.mesh_force_n": {"synchronizer.F_mesh_typ"},
    "stroke.impulse_factor": {"synchronizer.impulse_typ", "synchronizer.impulse_max"},
    "stroke.scatter_factor": {
        f"repeatability.{name}_sd"
        for name in ("friction", "valve_delay", "supply", "unit_flow", "unit_friction",
                     "unit_valve_delay")
    },
    "controller.filter.order": {"position_sensor.butter_order"},
    "controller.filter.fc_hz": {"position_sensor.butter_fc"},
    "sensor.delay_s": {"position_sensor.latency"},
}  # fmt: skip
"""Inferred numbers that the study varies by other paths than their own."""


def test_every_inferred_number_is_varied_or_named_with_a_reason() -> None:
    parameters = load()
    inferred = {path for path in parameters if parameters[path].source.startswith("inferred")}
    not_varied = {path for paths in NOT_VARIED.values() for path in paths}
    swept = set()
    for sweep in load_study("sensitivity").file.sweep:
        factor = FACTORS.get(sweep.path.removeprefix("factor."))
        swept |= (
            set(factor(parameters, 1.0)) if factor else BY_CONDITION.get(sweep.path, {sweep.path})
        )
    assert inferred <= swept | not_varied
    assert not_varied <= inferred and not not_varied & swept


@pytest.mark.slow
def test_the_numbers_that_are_not_varied_decide_no_headline() -> None:
    study, parameters = load_study("sensitivity"), load()
    others = {"damper.air_fraction": 1.0, "gauge.adc_bits": 1.25}
    changed: dict[str, float | str] = {
        path: others.get(path, 1.5) * parameters.value(path)
        for paths in NOT_VARIED.values()
        for path in paths
        if not isinstance(parameters[path].value, tuple)
    }
    nominal, other = (study.run(StudyRow(0, (), given)).figures for given in ({}, changed))
    assert set(HEADLINES) < set(nominal)
    assert dict(nominal) == dict(other)


@pytest.mark.parametrize("name", FACTORS)
def test_a_factor_of_one_changes_nothing_and_its_maps_have_no_jump(name: str) -> None:
    parameters = load()
    for path, value in FACTORS[name](parameters, 1.0).items():
        assert value == pytest.approx(parameters[path].value, rel=1e-12), path
    for factor in (0.7, 1.5):
        changed = parameters.override(FACTORS[name](parameters, factor))
        split = changed.value("flow_charge.y_split"), changed.value("flow_discharge.z_split")
        for table, at in zip(("flow_charge", "flow_discharge"), split, strict=True):
            low, high = (
                np.polynomial.Polynomial(changed.values(f"{table}.{part}"))(at)
                for part in ("c_low", "c_high")
            )
            assert low == pytest.approx(high, rel=1e-6)


def test_factors_keep_what_they_should() -> None:
    parameters = load()

    def dead_m3(changed: ParameterSet) -> float:
        value = changed.value
        swept = value("length.A_p") * (value("length.x_free_total") + value("length.stroke"))
        return value("length.V_N0") - swept

    for name in ("piston_area", "travel", "free_travel"):
        changed = parameters.override(FACTORS[name](parameters, 1.1))
        assert changed.value("length.V_N0") > 1.01 * parameters.value("length.V_N0")
        assert dead_m3(changed) == pytest.approx(dead_m3(parameters))
    shares = FACTORS["stay_friction"](parameters, 1.5)
    assert shares["friction_length.F_sf_s"] == pytest.approx(46.5)
    assert shares["friction_length.F_sf_p"] == pytest.approx(24.5)
    shape = parameters.override(FACTORS["charge_shape"](parameters, 0.5))
    low = (each.values("flow_charge.c_low") for each in (parameters, shape))
    nominal, stretched = map(np.polynomial.Polynomial, low)
    assert stretched(0.8) == pytest.approx(nominal(0.9))


def made_up() -> tuple[Study, dict[str, Floats], dict[str, Floats]]:
    """Return the shipped study, its swept values, and margins of 0.5 for every headline, each [rows]."""
    study = load_study("sensitivity")
    rows = list(study.rows())
    swept = {
        sweep.path: np.array([row.settings[sweep.path] for row in rows])
        for sweep in study.file.sweep
    }
    return study, swept, {name: np.full(len(rows), 0.5) for name in HEADLINES}


def test_the_tables_name_what_turns_and_what_is_not_varied() -> None:
    """Made-up margins: all 0.5 but the first headline with the heaviest gearbox."""
    study, swept, margins = made_up()
    margins["damper_m_s"][swept["truck.m_gearbox"] == 120.0] = -0.25
    text = study.file.texts(study, Table({}, swept | margins, study.size))["sensitivity.md"]
    turning, others = text.split("| turns none |")
    assert "1. the oil damper softens the hardest of the gearbox loads: 0.50 m/s" in turning
    assert "| gearbox mass, kg: 3 to 120 | **-0.25 to 0.50; holds: 3 to 90** | none |" in turning
    assert turning.count("holds") == 1
    assert others.count("\n| ") == len(study.file.sweep)  # the rule below the head is one
    assert all(path in others for paths in NOT_VARIED.values() for path in paths)


def test_a_headline_without_any_row_is_not_run_and_not_drawn() -> None:
    study, swept, margins = made_up()
    margins["late_s"][:] = np.nan
    table = Table({}, swept | margins, study.size)
    (text,) = study.file.texts(study, table).values()
    assert text.count("not run") == len(study.file.sweep)
    stacks = study.file.draw(study, table)["sensitivity"].stacks
    drawn = [len(stack.panels[0].spans) for stack in stacks]
    assert drawn == [0 if name == "late_s" else len(study.file.sweep) for name in HEADLINES]


@pytest.mark.parametrize("name", ["charge_shape", "discharge_shape", "travel"])
def test_a_factor_of_nothing_is_refused(name: str) -> None:
    row = StudyRow(0, (), {f"factor.{name}": 0.0})
    with pytest.raises(InputError, match=rf"factor\.{name}: 0; expected above 0$"):
        load_study("sensitivity").run(row)


@pytest.mark.parametrize(
    ("path", "value", "least"),
    [("stroke.mesh_force_n", "-1.0", "0"), ("stroke.supply_pressure_pa", "9e4", "100000")],
)
def test_a_condition_below_its_least_value_is_refused_when_loading(
    tmp_path: Path, path: str, value: str, least: str
) -> None:
    head = 'name = "own"\ndescription = "d"\nkind = "sensitivity"\nreads = ["late_s"]\n'
    swept = f'[[sweep]]\npath = "{path}"\nvalues = [9e5, {value}]\n'
    chosen = f'[[variant]]\nname = "v"\nset = {{ "{path}" = {value} }}\n'
    for given in (swept, chosen):
        file = tmp_path / "own.toml"
        file.write_text(f'{head}[design]\nkind = "grid"\n{given}')
        with pytest.raises(InputError, match=rf"{path}: .* expected .*{least}"):
            load_study(str(file))


def test_a_range_in_words() -> None:
    x = np.array([1.0, 2.0, 3.0])
    assert in_words(x, np.array([0.3, 0.302, 0.301]), 2) == "none"
    assert in_words(x, np.array([0.3, 0.5, np.nan]), 2) == "0.30 to 0.50"
    assert in_words(x, np.full(3, np.nan), 2) == "not run"
    assert in_words(x, np.array([-0.1, 0.5, 0.2]), 2) == "**-0.10 to 0.50; holds: 2 to 3**"
    assert in_words(x, np.array([-0.001, -0.001, -0.001]), 2) == "**-0.00 to -0.00; holds: never**"


def test_a_heavy_gearbox_turns_a_headline() -> None:
    """With 120 kg a stroke lasts longer than 48 ms after its release, or nearly."""
    study = load_study("sensitivity_global")
    nominal, heavy = (
        study.run(StudyRow(0, (), {"truck.m_gearbox": mass})).figures for mass in (9.0, 160.0)
    )
    assert nominal["late_s"] > 0.02 > 0.0 > heavy["late_s"]
    assert nominal["damper_m_s"] > 0.7 > 0.3 > heavy["damper_m_s"]
    assert nominal["cushion_m_s"] == heavy["cushion_m_s"]
    with pytest.raises(InputError, match=r"factor\.frictions: unknown; expected one of"):
        study.run(StudyRow(0, (), {"factor.frictions": 2.0}))


def test_a_normal_range_has_its_quantiles() -> None:
    sweep = SweptValue(path="x", low=1.0, high=3.0, scale="normal")
    for share, value in ((0.025, 1.0), (0.5, 2.0), (0.975, 3.0)):
        assert sweep.at_share(share) == pytest.approx(value)


def test_intervals_of_shares_and_quantiles() -> None:
    assert share_interval(0, 200) == pytest.approx([0.0, 0.0188], abs=1e-3)
    low, high = share_interval(50, 100)
    assert low == pytest.approx(0.404, abs=1e-3) and high == pytest.approx(0.596, abs=1e-3)
    quantile = quantiles(np.append(np.arange(1001.0), np.nan))
    for name, middle in (("p5", 50.0), ("p50", 500.0), ("p95", 950.0)):
        value, low, high = quantile[name]
        assert value == pytest.approx(middle) and low < value < high < value + 40.0
    assert quantiles(np.array([np.nan])) == {}
    covered = 0
    rng = np.random.default_rng(0)
    for _ in range(300):
        _, low, high = quantiles(rng.normal(size=200))["p95"]
        covered += low <= 1.6449 <= high
    assert 0.90 <= covered / 300 <= 0.99


def test_a_normal_range_in_a_grid_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\nscenario = "lab_n_b"\n[[sweep]]\npath = "valve.D_rise"\n'
        'low = 0.007\nhigh = 0.009\nsteps = 3\nscale = "normal"\n'
    )
    assert main(["whatif", str(file), "--out", str(tmp_path / "o")]) == 2
    assert "a normal range needs a design that draws" in capsys.readouterr().err


def test_the_indices_of_a_study_are_drawn_and_its_rows_sum_up(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\nscenario = "lab_n_b"\nreads = ["impact_worst_m_s"]\n'
        '[design]\nkind = "lhs"\nsamples = 6\n[[sweep]]\npath = "valve.D_rise"\n'
        'low = 0.007\nhigh = 0.009\nscale = "normal"\n'
        '[[load]]\nname = "lab"\nset = { duration_s = 0.4 }\n'
    )
    assert main(["whatif", str(file), "--out", str(tmp_path / "o"), "--quiet"]) == 0
    text = (tmp_path / "o" / "summary.json").read_text()
    assert '"p95"' in text and '"failed_interval"' in text
    assert all(a <= b for a, b in pairwise(share_interval(3, 6)))
