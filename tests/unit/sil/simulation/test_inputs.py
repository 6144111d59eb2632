"""A study is resumed only if everything that its rows depend on is as it was."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.simulation.inputs import changed_inputs
from sil.studies.executor import STATE, run_study
from sil.studies.load_study import load_study
from sil.studies.table import RESULTS

STUDY = """
name = "closing"
scenario = "my.toml"
model = "model.toml"
[[sweep]]
path = "valve.D_fall"
values = [0.01, 0.02]
"""
MODEL = '[base]\nmodel = "base.toml"\n'
BASE = (
    '[base]\nmodel = "nominal"\n[valve]\nD_rise = { value = 0.008, unit = "s", source = "test" }\n'
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    files = {
        "study.toml": STUDY,
        "model.toml": MODEL,
        "base.toml": BASE,
        "my.toml": 'name = "my"\nduration_s = 0.2\ninitial_gear = "neutral"\nfirmware = "own.py:Own"\n',
        "own.py": "import numpy\nfrom controller.firmware import Firmware\nfrom helper import GAIN\n",
        "helper.py": "import parts.curve\nGAIN = 1\n",
        "parts/curve.py": "from . import knots\n",  # a folder without __init__.py
        "parts/knots.py": "",
        "unrelated.py": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_every_file_that_decides_a_row_counts(folder: Path) -> None:
    def digests() -> dict[str, str]:
        return load_study(str(folder / "study.toml")).input_digests()

    before = digests()
    named = {str(Path(name).relative_to(folder)) for name in before if str(folder) in name}
    python = {"own.py", "helper.py", "parts/curve.py", "parts/knots.py"}
    assert named == {"my.toml", "model.toml", "base.toml", *python}
    assert {"the study", "its scenario", "the program", "numpy", "opc4-sil"} <= before.keys()
    assert changed_inputs(before, digests()) == []
    for name in sorted(named - {"my.toml"}):
        (folder / name).write_text((folder / name).read_text() + "# changed\n")
        assert changed_inputs(before, digests()) == [str(folder / name)]
        before = digests()


def test_a_study_with_another_model_is_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.toml").write_text(BASE)
    stroke = (
        STUDY.replace('scenario = "my.toml"\n', "")
        + '[stroke]\nkind = "N-B"\ncommands = [[0.01, "B", 0.98]]\n'
    )
    (tmp_path / "study.toml").write_text(stroke)
    study = load_study(str(tmp_path / "study.toml"))
    out = tmp_path / "out"
    out.mkdir()
    run_study(study, out)
    table = (out / RESULTS).read_text()
    assert run_study(study, out, resume=True) == 0
    (tmp_path / "model.toml").write_text(BASE.replace("0.008", "0.020"))
    with pytest.raises(InputError, match=r"another study: \S*model\.toml changed since; expected"):
        run_study(study, out, resume=True)
    assert (out / RESULTS).read_text() == table
    assert json.loads((out / STATE).read_text())["study"] == "closing"
