"""A user's own effects: loaded into the catalogue, or refused with one clear line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from plant.effects import CATALOGUE, added_term, look_alikes, overridden
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.user_file import (
    _LOADED,
    MARK,
    check_neutral,
    load_effects,
    loaded_effects,
    probe_setups,
)
from plant.errors import InputError, IntegrationError
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import simulate

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
    "no effects": ("EFFECTS = (end_seal,)", "", r": no EFFECTS; expected EFFECTS = "),
    "no effect": ("(end_seal,)", "(3,)", r": EFFECTS: 3; expected functions under @effect"),
    "exit": ("EFFECTS", "raise SystemExit(1)\nEFFECTS", r":30: SystemExit: 1; expected"),
    "process": ("EFFECTS", "import os; os._exit(3)\nEFFECTS", r":30: ProcessExit: os\._exit\(3\)"),
    "division": ("EFFECTS", "1 / 0\nEFFECTS", r":30: ZeroDivisionError: division by zero; expected"),
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
    monkeypatch.setattr(added_term, "TIME_LIMIT_S", 0.05)
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
    path.write_text(f"from imported_{number} import EFFECTS\n", encoding="utf-8")
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
