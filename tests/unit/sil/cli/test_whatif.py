"""`opc4 whatif`: exit codes, reasons of rows, and the hint to resume."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from sil import api
from sil.cli import main

STUDY = """
name = "pressures"
scenario = "lab_n_b"
[[sweep]]
path = "plant.supply_pressure_pa"
values = [{pressures}]
"""
TOO_LOW = "102000.0"


def study(folder: Path, pressures: str) -> str:
    path = folder / "study.toml"
    path.write_text(STUDY.replace("{pressures}", pressures))
    return str(path)


def test_a_failed_row_has_its_reason_and_ends_with_1(tmp_path: Path, capsys: Any) -> None:
    path, out = study(tmp_path, f"{TOO_LOW}, 900000.0"), tmp_path / "out"
    assert main(["whatif", path, "--out", str(out)]) == 1
    with open(out / "results.csv", newline="") as file:
        failed, passed = csv.DictReader(file)
    assert (failed["outcome"], passed["outcome"], passed["reason"]) == ("failed", "passed", "")
    said = "the shift to backward did not arrive; the controller reported"
    assert failed["reason"].startswith(said)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcomes"] == {"passed": 1, "failed": 1, "not_run": 0}
    (reason,) = summary["reasons"]
    assert reason["reason"] == failed["reason"] and reason["first_row"] == 0
    assert failed["reason"] in (out / "report.html").read_text()
    assert f"1 failed: {failed['reason']} (row 0)" in capsys.readouterr().out


def test_a_model_replaces_that_of_the_study(tmp_path: Path, capsys: Any) -> None:
    path, model = study(tmp_path, "900000.0"), tmp_path / "slow.toml"
    model.write_text(
        '[base]\nmodel = "nominal"\n[valve]\nD_rise = { value = 0.02, unit = "s", source = "test" }\n'
    )
    times = []
    for name, words in (("own", []), ("slow", ["--model", str(model)])):
        assert main(["whatif", path, "--out", str(tmp_path / name), *words]) == 0
        with open(tmp_path / name / "results.csv", newline="") as file:
            times += [float(row["shift_time_s"]) for row in csv.DictReader(file)]
    assert times[1] == pytest.approx(times[0] + 0.012, abs=1e-4)
    assert f"--model {model}" in (tmp_path / "slow" / "report.html").read_text()
    capsys.readouterr()
    assert main(["whatif", path, "--out", str(tmp_path / "none"), "--model", "nominl"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("opc4 whatif: --model: model 'nominl': no such parameter set; expected")
    assert not (tmp_path / "none").exists()
    model.write_text('[base]\nmodel = "nominal"\n[effect.none]\n')
    for command in (["whatif", path], ["run", "lab_n_b"]):
        assert main([*command, "--out", str(tmp_path / "none"), "--model", str(model)]) == 2
        said = f"opc4 {command[0]}: --model: {model}: effect 'none': no such effect"
        assert capsys.readouterr().err.startswith(said)
        assert not (tmp_path / "none").exists()
    with open(path, "r+", encoding="utf-8") as file:
        text = file.read()
        file.seek(0)
        file.write('model = "none.toml"\n' + text)
    assert main(["whatif", path, "--out", str(tmp_path / "none")]) == 2
    said = f"opc4 whatif: {path}: model: none.toml: no such file; expected a TOML file\n"
    assert capsys.readouterr().err == said


def test_a_study_whose_first_row_is_refused_leaves_no_folder(tmp_path: Path, capsys: Any) -> None:
    path, out = study(tmp_path, '"high"'), tmp_path / "out"
    assert main(["whatif", path, "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "row 0: --set: plant.supply_pressure_pa: 'high' is wrong; expected" in line
    assert not out.exists()


FIRMWARE = """
import os
import sys
class Firmware:
    def __init__(self, config):
        pass
    def step(self, now_ns, inputs):
        {leave}
"""


@pytest.mark.parametrize("leave", ["sys.exit(0)", "os._exit(0)"])
def test_firmware_that_ends_its_process_ends_the_study_with_3(tmp_path: Path, leave: str) -> None:
    own = tmp_path / "own.py"
    own.write_text(FIRMWARE.replace("{leave}", leave))
    path, out = study(tmp_path, TOO_LOW), tmp_path / "out"
    with open(path, "a", encoding="utf-8") as file:
        file.write('[[variant]]\nname = "ours"\n[[variant]]\nname = "own"\n')
        file.write(f'set = {{ firmware = "{own}" }}\n')
    assert main(["whatif", path, "--out", str(out)]) == 3
    swept = api.whatif(path, out=tmp_path / "api")
    assert swept.texts["outcome"] == ["failed", "not run"] and not swept.passed
    assert f"{own}:8: " in swept.texts["reason"][1]
    assert swept.numbers["failed"].tolist() == [1.0, 1.0]
    assert not (out / "INCOMPLETE").exists() and (out / "summary.json").exists()


def test_repeating_an_interrupted_sweep_names_resume(tmp_path: Path, capsys: Any) -> None:
    path, out = study(tmp_path, "600000.0, 900000.0"), tmp_path / "out"
    assert main(["whatif", path, "--out", str(out)]) == 0
    whole = (out / "results.csv").read_bytes()
    (out / "results.csv").write_bytes(whole[:-5])
    (out / "summary.json").unlink()
    assert main(["whatif", path, "--out", str(out)]) == 2
    assert "holds 1 of 2 rows of this study; expected --resume" in capsys.readouterr().err
    assert (out / "results.csv").read_bytes() == whole[:-5]
    assert main(["whatif", path, "--out", str(out), "--resume"]) == 0
    assert (out / "results.csv").read_bytes() == whole


LOADED = """
name = "loaded"
scenario = "lab_n_b"
reads = ["shift_time_s"]
baseline = { "valve.D_rise" = "10ms" }
[[sweep]]
path = "valve.D_rise"
values = ["8ms", "10ms"]
[[load]]
name = "9 bar"
[[load]]
name = "6 bar"
set = { "plant.supply_pressure_pa" = "6bar" }
"""


def test_each_row_is_compared_with_the_baseline_under_the_same_load(
    tmp_path: Path, capsys: Any
) -> None:
    path, out = tmp_path / "loaded.toml", tmp_path / "out"
    path.write_text(LOADED)
    assert main(["whatif", str(path), "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["shift", "time,", "ms", "difference"]
    assert [line.split()[-1] for line in lines[1:5]] == ["-2", "-2", "baseline", "baseline"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["baseline_rows"] == [2, 3]
    difference_s = summary["groups"]["6 bar"]["shift_time_s"]["difference"]
    assert difference_s == pytest.approx(-0.001, abs=1e-5)  # the median of -2 ms and 0
    assert "baseline" in (out / "report.html").read_text()
    path.write_text(LOADED.replace('"10ms" }', '"11ms" }'))
    assert main(["whatif", str(path), "--out", str(tmp_path / "no")]) == 2
    said = "baseline.valve.D_rise: 0.011; expected one of 0.008, 0.01\n"
    assert capsys.readouterr().err.endswith(said)
