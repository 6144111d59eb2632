"""Effects: the catalogue, the terms that they add, and a user's own."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.batch.batch import Strokes, simulate_batch
from plant.batch.prediction import Predictor
from plant.effects import CATALOGUE, added_term, effect, look_alikes, overridden
from plant.effects.added_term import MOST_ADDED, AddedTerm, Slot
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.term import FORMS, LEVELLED, LEVELS, term
from plant.effects.user_file import (
    _LOADED,
    MARK,
    check_neutral,
    load_effects,
    loaded_effects,
    probe_setups,
)
from plant.errors import IntegrationError
from plant.integrator.loop import DONE
from plant.node import PlantConfig, PlantNode
from plant.parameters import Parameter, ParameterSet, load
from plant.systems.length_stroke import LengthStroke
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup, simulate

ROOT = Path(__file__).resolve().parents[4]
ELSEWHERE = {
    ("plant/batch/lane_steps.py", "alpha_speed")  # a field of the parameters
}
ORDINARY = {"stribeck", "detent", "unnamed"}
"""Identifiers that are words: they are names of effects only where they are the whole string."""


def named_in(file: Path) -> set[str]:
    """Return the effects that the strings of a module name, docstrings left out."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    mentions = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            words = set("".join(c if c.isalnum() or c == "_" else " " for c in node.value).split())
            mentions |= {name for name in CATALOGUE if name == node.value}
            mentions |= (words & set(CATALOGUE)) - ORDINARY
    return mentions


def test_no_module_outside_the_effects_names_one() -> None:
    mentions = set()
    for package in ("can_dbc", "controller", "plant", "sil"):
        for file in (ROOT / package).rglob("*.py"):
            path = file.relative_to(ROOT).as_posix()
            if not path.startswith("plant/effects/"):
                mentions |= {(path, name) for name in named_in(file)}
    assert mentions == ELSEWHERE


def test_the_search_for_names_finds_them() -> None:
    assert "exhaust_clog" in named_in(ROOT / "plant/effects/flow.py")


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=lambda item: item.id)
def test_an_effect_is_stated_consistently(item) -> None:
    names = [p.name for p in item.parameters]
    assert len(set(names)) == len(names)
    for parameter in item.parameters:
        assert parameter.low <= parameter.neutral <= parameter.high and parameter.typical > 0.0
    fixable = {p.name for p in item.parameters if p.optional or not p.fitted}
    for variant in item.variants:
        assert set(variant.fixed) <= fixable
    assert len({variant.name for variant in item.variants}) == len(item.variants)
    for other in look_alikes(item.id):
        assert other != item.id and item.id in look_alikes(other)
    assert set(item.look_alikes) <= set(CATALOGUE)
    assert item.scope_of({p.name: p.neutral for p in item.parameters}) in (
        "unit",
        "run",
        "stroke",
        "instrument",
    )


def test_every_named_effect_but_a_few_has_look_alikes() -> None:
    alone = {name for name, item in CATALOGUE.items() if not look_alikes(name)}
    assert alone == {term.id}


def test_terms_of_levels_depend_on_what_has_a_level() -> None:
    for form in FORMS:
        assert (form.slot in LEVELLED) == (form.over in LEVELS), form.name


def test_an_unknown_effect_is_named_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"expected one of .*exhaust_clog"):
        effect("exhaust_clogged")


def extended(name: str, **values: tuple[float, str]) -> ParameterSet:
    base = load()
    table = {key: Parameter(value, unit, "test") for key, (value, unit) in values.items()}
    return ParameterSet(base.name, base.entries, {name: table})


def test_a_run_moves_as_the_stroke_of_the_same_model() -> None:
    model = extended("dynamic_friction", factor=(3.0, "-"))
    conditions = StrokeConditions("N-B", 900000.0, ((0.002, "B", 0.98),))
    time_s = np.arange(1, 601) * 1e-4
    stroke = simulate(model, conditions, np.concatenate([[0.0], time_s]), internal=False)
    run = LengthStroke(model, supply_pressure_pa=900000.0)
    states = run.advance(60_000_000, [(10_000_000, 0, 1.0)], np.rint(time_s * 1e9).astype(np.int64))
    assert states[:, 0] == pytest.approx(stroke.position_m[1:], abs=1e-7)
    plain = LengthStroke(load(), supply_pressure_pa=900000.0)
    free = plain.advance(60_000_000, [(10_000_000, 0, 1.0)], np.rint(time_s * 1e9).astype(np.int64))
    assert np.max(free[:, 0] - states[:, 0]) > 1e-3


def test_valve_delays_reach_the_valves() -> None:
    node = PlantNode(PlantConfig(), extended("valve_open_delay", delay_s=(0.004, "s")))
    plain = PlantNode(PlantConfig(), load())
    late, prompt = (each.valve_group.valves[0].timing for each in (node, plain))
    assert late.rise_ns == prompt.rise_ns + 4_000_000 and late.fall_ns == prompt.fall_ns


@pytest.mark.parametrize(
    ("name", "values", "reported"),
    [
        ("residual_pressure", {"pressure_pa": (3e3, "Pa")}, "single stroke"),
        ("dead_volume_charge", {"volume_m3": (5e-6, "m^3")}, "single stroke"),
        ("sensor_gain", {"gain": (0.02, "-")}, "instruments"),
        ("dynamic_friction", {"factor": (30.0, "-")}, "expected 0.2 to 10"),
    ],
)
def test_what_a_run_cannot_apply_is_refused(name, values, reported) -> None:
    with pytest.raises(InputError, match=reported):
        LengthStroke(extended(name, **values))


def test_volumes_of_named_chambers_are_applied() -> None:
    model = extended("dead_volume_passive", volume_m3=(5e-6, "m^3"), where=(1.0, "-"))

    assert LengthStroke(model).packed.vol_n == pytest.approx(
        LengthStroke(load()).packed.vol_n + 5e-6
    )


VALVE = {"fixed": "1", "N-B": "B", "F-N": "N"}
TIME_S = np.linspace(0.0, 0.25, 126)


def setup_of(kind: str) -> Setup:
    return make_setup(load(), StrokeConditions(kind, 9e5, ((0.01, VALVE[kind], 0.98),)))


def spring(position_m: float, rate_n_m: float, x0_m: float) -> float:
    return -rate_n_m * (position_m - x0_m)


def drag(direction: float, force_n: float, more_n: float) -> float:
    return force_n + direction * more_n


def leak(pressure_pa: float, valve: float, per_pa: float) -> float:
    return (1.0 - 0.5 * valve) * per_pa * (pressure_pa - 101325.0)


def share(pressure_ratio: float, amount: float) -> float:
    return amount * pressure_ratio


def shifted(speed_m_s: float, amount: float) -> float:
    return amount * speed_m_s


SPRING = AddedTerm(Slot.FORCE, spring)


@pytest.mark.parametrize("kind", VALVE)
def test_a_force_that_is_a_spring_moves_as_the_spring_of_the_equations(kind) -> None:
    one, other = setup_of(kind), setup_of(kind)
    one.p.spring_k, one.p.spring_x0 = 8000.0, 0.001
    SPRING.add_to(other, rate_n_m=8000.0, x0_m=0.001)
    stroke, added = run_setup(one, TIME_S), run_setup(other, TIME_S)
    assert np.allclose(added.states, stroke.states, rtol=1e-6, atol=1e-8)
    assert added.balance.closed and np.ptp(added.position_m) > 0.003
    assert np.abs(run_setup(setup_of(kind), TIME_S).position_m - added.position_m).max() > 1e-4


@pytest.mark.parametrize(
    ("slot", "function", "values"),
    [
        (Slot.RESISTANCE, drag, {"force_n": 60.0, "more_n": 5.0}),
        (Slot.LEAK, leak, {"per_pa": 1e-6}),
        (Slot.FLOW_1, leak, {"per_pa": -1e-6}),
        (Slot.FLOW_2, leak, {"per_pa": 1e-6}),
        (Slot.CHARGE, share, {"amount": -0.4}),
        (Slot.DISCHARGE, share, {"amount": -0.1}),
        (Slot.EXPONENT, shifted, {"amount": 0.1}),
    ],
)
@pytest.mark.parametrize("kind", ["fixed", "N-B"])
def test_every_slot_changes_the_stroke_and_balances_close(kind, slot, function, values) -> None:
    setup = setup_of(kind)
    AddedTerm(slot, function).add_to(setup, **values)
    stroke, nominal = run_setup(setup, TIME_S), run_setup(setup_of(kind), TIME_S)
    assert stroke.balance.closed
    assert np.abs(stroke.states - nominal.states).max() > 1e-4


def test_a_batch_runs_strokes_with_and_without_terms() -> None:
    plain, changed = setup_of("N-B"), setup_of("N-B")
    SPRING.add_to(changed, rate_n_m=8000.0, x0_m=0.001)
    result = simulate_batch(Strokes.from_setups([plain, changed, plain], 0.25), sample_s=TIME_S)
    assert result.in_lanes.tolist() == [True, False, True] and (result.status == DONE).all()
    alone = simulate_batch(Strokes.from_setups([plain], 0.25), sample_s=TIME_S)
    assert (result.samples[0] == alone.samples[0]).all()
    single = run_setup(changed, TIME_S).position_m
    assert np.abs(result.samples[1, :, 0] - single).max() < 1e-6


def test_derivatives_by_a_value_are_those_of_wide_differences() -> None:
    def at(rate_n_m: float) -> Setup:
        setup = setup_of("fixed")
        SPRING.add_to(setup, rate_n_m=rate_n_m, x0_m=0.001)
        return setup

    predictor = Predictor((TIME_S * 1e9).astype(np.int64))
    _states, (slope,) = predictor.derivatives(at(8000.0), [at(8000.01)], [0.01], [0])
    assert slope is not None
    wide = (
        run_setup(at(8100.0), TIME_S).position_m - run_setup(at(7900.0), TIME_S).position_m
    ) / 200
    assert np.abs(slope[:, 0] - wide).max() < 0.02 * np.abs(wide).max()


def test_what_does_not_fit_is_refused() -> None:
    setup = setup_of("fixed")
    with pytest.raises(InputError, match="values force_n; expected rate_n_m, x0_m"):
        SPRING.add_to(setup, force_n=1.0)
    for _ in range(MOST_ADDED):
        SPRING.add_to(setup, rate_n_m=1.0, x0_m=0.0)
    with pytest.raises(
        InputError, match="4 added terms of 8 values on one stroke; expected at most 3"
    ):
        SPRING.add_to(setup, rate_n_m=1.0, x0_m=0.0)


SEAL = Path(__file__).with_name("end_seal.py").read_text(encoding="utf-8")


@pytest.fixture
def write(tmp_path: Path) -> Iterator:
    """Write the file of the how-to with something replaced; what it loads is unloaded again."""

    def make(old: str = "", new: str = "") -> str:
        assert old in SEAL
        path = tmp_path / "mine.py"
        path.write_text(SEAL.replace(old, new, 1), encoding="utf-8")
        return str(path)

    yield make
    for _digest, names in _LOADED.values():
        for name in names:
            CATALOGUE.pop(name, None)
    _LOADED.clear()


def test_a_file_adds_its_effects_once(write) -> None:
    path = write()
    stamp = load_effects(path)
    assert load_effects(stamp) == load_effects(path) == stamp == loaded_effects()["end_seal"]
    assert stamp.startswith(path + MARK) and CATALOGUE["end_seal"].cause_class == "friction"
    assert "end_seal" in look_alikes("friction_bump")


def test_a_changed_file_replaces_its_effects_and_is_refused_under_the_old_hash(write) -> None:
    stamp = load_effects(write())
    load_effects(write('"end_seal",', '"end_grip",'))
    assert "end_grip" in CATALOGUE and "end_seal" not in CATALOGUE
    with pytest.raises(InputError, match=r"mine\.py: has changed: sha256 \w{12}; expected \w{12}"):
        load_effects(stamp)


def test_a_set_takes_an_effect_by_its_paths(write) -> None:
    load_effects(write())
    changes = {"effect.end_seal.force_n": 60.0, "effect.end_seal.length_m": 0.002}
    extended = overridden(load(), {**changes, "valve.D_rise": 0.013})
    assert extended.value("valve.D_rise") == 0.013
    assert extended.effects["end_seal"]["force_n"].value == 60.0
    with pytest.raises(InputError, match="no length_m; expected force_n, length_m"):
        overridden(load(), {"effect.end_seal.force_n": 60.0})


GRIP = "    return force_n * exp(-left_m / length_m)"
SIZE = 'EffectParameter("force_n", "N", neutral=0.0, low=0.0'
WRONG = {
    "no Python": (GRIP, "    return return", r":13: not valid Python: invalid syntax; expected a Python"),
    "no effect": ("setup.p.stroke)", "setup.p.stroke)\n\n\ndel end_seal", r": no effect; expected functions under @effect"),
    "exit": ("setup.p.stroke)", "setup.p.stroke)\n\n\nraise SystemExit(1)", r":30: SystemExit: 1; expected"),
    "process": ("setup.p.stroke)", "setup.p.stroke)\n\n\nimport os; os._exit(3)", r":30: ProcessExit: os\._exit\(3\)"),
    "division": ("setup.p.stroke)", "setup.p.stroke)\n\n\n1 / 0", r":30: ZeroDivisionError: division by zero; expected"),
    "no import": ("math import exp", "maths import exp", r":3: ModuleNotFoundError: No module named"),
    "missing field": (", typical=50.0", "", r":21: TypeError: EffectParameter\(\) missing .* 'typical'"),
    "missing what": ('"force",\n', "\n", r":\d+: (TypeError|.*what)"),
    "no prior": ('look_alikes=', 'variants=(effect.__globals__["Variant"](prior=0.0),), look_alikes=', r"variant '': prior 0.0; expected more than 0"),
    "id exists": ('"end_seal"', '"exhaust_clog"', r":\d+: effect 'exhaust_clog': exists already"),
    "id": ('"end_seal"', '"End seal"', r": effect 'End seal': expected an id in lower case"),
    "bounds": (SIZE, SIZE.replace("low=0.0", "low=1.0"), r"force_n: neutral 0; expected it from low 1"),
    "bound": ("high=2000.0", "high='x'", r"force_n: high 'x'; expected a finite number"),
    "sign": ("sign=1", "sign=3", r"force_n: sign 3; expected -1, 0 or 1"),
    "look-alike": ("static_friction", "static_fricton", r"'static_fricton' is no effect; expected one of static_f"),
    "look-alike without a comma": ('("friction_bump", "static_friction")', '("friction_bump")', r"look_alikes: 'friction_bump'; expected a tuple of ids"),
    "needs": ("    look", '    needs=("oil",),\n    look', r"needs: 'oil'; expected damper, internal"),
    "scope": ("    look", '    scope="me",\n    look', r"scope 'me'; expected unit, run, stroke"),
    "field": ("    look", "    colour=3,\n    look", r": TypeError: .*colour"),
    "slot": ("Slot.RESISTANCE", "Slot.GAUGE", r":9: slot .*: no term can be added there; expected FORCE"),
    "name": (GRIP, GRIP.replace("exp", "expo"), r":9: grip: numba cannot compile it: NameError: name 'expo'"),
    "text": (GRIP, "    return 'text'", r": grip: numba cannot compile it: No conversion from Literal"),
    "nothing": (GRIP, "    pass", r": grip: numba cannot compile it: No conversion from none to float64;"),
    "file": (GRIP, "    with open('x') as f:\n        return f", r"grip: numba cannot compile it: The 'with"),
    "raise": (GRIP, "    raise ValueError", r":9: grip: raises an error; expected a number"),
    "argument": ("end_m):", "end):", r":\d+: grip: values force_n, length_m, end_m; expected force_n, l"),
    "signature": ("end_m):", "*end_m):", r":9: grip: \*, / or \*\* in its arguments; expected plain"),
    "not a number": ("/ length_m)", "/ length_m) / (end_m - end_m)", r"grip\(position_m=-0.03, .*\) = nan"),
    "infinite": ("low=2e-4", "low=0.0", r": grip\(position_m=.*length_m=0.*\) = nan; expected a finite"),
    "not neutral": (GRIP, GRIP + " + 1.0", r"grip\(position_m=-0.03, .*\) = 1 at the neutral parameters; exp"),
    "changes": ("    grip.add", "    setup.p.f_external += 5\n    grip.add", r"it changes f_external from 0.0 to 5"),
    "in use": ("    grip.add", "    setup.none += 5\n    grip.add", r":\d+: AttributeError: .*none"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_in_one_line(write, case) -> None:
    old, new, message = WRONG[case]
    path = write(old, new)
    with pytest.raises(InputError) as caught:
        load_effects(path)
    said = str(caught.value)
    assert said.startswith(path) and "\n" not in said
    assert "expected" in said and re.search(message, said), said
    assert "end_seal" not in CATALOGUE and not loaded_effects()


def test_a_term_that_does_not_return_is_refused(write, monkeypatch) -> None:
    monkeypatch.setattr(added_term.AddedTerm, "time_limit_s", 0.05)
    path = write(GRIP, "    while force_n < 1e9:\n        force_n += 1.0\n    return force_n")
    with pytest.raises(
        InputError, match=r"mine\.py:9: grip\(.*\) does not return within 0.05 s; exp"
    ):
        load_effects(path)


AT_61 = "    if values['force_n'] == 61.0:\n        {}\n    grip.add"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("raise KeyError('oops')", r"mine\.py:28: KeyError: 'oops'; expected"),
        ("raise SystemExit(4)", r"mine\.py:28: SystemExit: 4; expected"),
        ("import os; os._exit(4)", r"mine\.py:28: ProcessExit: os\._exit\(4\); expected"),
        ("setup.p.f_run_s = 'x'", r"mine\.py:28: ValueError: could not convert string to float"),
        ("setup.p.f_run_s = float('nan')", r"mine\.py:16: effect 'end_seal': at force_n=61, .* not finite"),
    ],
)  # fmt: skip
def test_an_error_at_values_that_were_not_tried_is_one_line(write, line, message) -> None:
    load_effects(write("    grip.add", AT_61.format(line)))
    changes = {"effect.end_seal.force_n": 61.0, "effect.end_seal.length_m": 0.002}
    parameters = overridden(load(), changes)
    with pytest.raises(InputError, match=message) as caught:
        make_setup(parameters, StrokeConditions("N-B", 9e5, ()))
    assert "\n" not in str(caught.value)


def test_a_term_that_is_no_number_somewhere_ends_the_stroke(write) -> None:
    between = "if 0.0070 < abs(position_m) < 0.0075:\n        return (force_n - force_n) / (end_m - end_m)"
    load_effects(write(GRIP, f"    {between}\n{GRIP}"))
    changes = {"effect.end_seal.force_n": 61.0, "effect.end_seal.length_m": 0.002}
    conditions = StrokeConditions("N-B", 9e5, ((0.01, "B", 0.98),))
    with pytest.raises(IntegrationError, match="the state is not finite"):
        simulate(overridden(load(), changes), conditions, np.linspace(0.0, 0.1, 11))


NO_ROOM = r"mine\.py: 4 added terms of 12 values on one stroke; expected at most"
NOT_FINITE = r"mine\.py: \S*/imported_{}\.py:16: effect 'end_seal': at .* not finite"


@pytest.mark.parametrize(
    ("number", "line", "message"),
    [
        (1, "for _ in range(60):\n        grip.add", NO_ROOM),
        (2, "setup.p.f_run_s = float('inf')\n    grip.add", NOT_FINITE.format(2)),
    ],
)
def test_an_imported_effect_is_refused_in_one_line(
    tmp_path, monkeypatch, number, line, message
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    helper = SEAL.replace("grip.add", line)
    (tmp_path / f"imported_{number}.py").write_text(helper, encoding="utf-8")
    path = tmp_path / "mine.py"
    path.write_text(f"from imported_{number} import end_seal\n", encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        load_effects(str(path))
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_missing_file_is_refused() -> None:
    with pytest.raises(InputError, match=r"none\.py: no such file; expected a Python file"):
        load_effects("none.py")


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=lambda item: item.id)
def test_the_catalogue_is_neutral_at_its_neutral_parameters(item) -> None:
    for setup in probe_setups(item) if not item.nonparametric else ():
        check_neutral(item, setup, item.id)
        twin = setup.copy()
        item.apply(twin, {})
        assert (twin.p.array == setup.p.array).all() and twin.timing == setup.timing
