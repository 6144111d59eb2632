"""From a truck's log to a verdict: what is hidden is found, a healthy truck is not accused."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sil.shift_diagnosis import page
from sil.shift_diagnosis.linear import NOISE
from sil.shift_diagnosis.model import catalogue
from sil.shift_diagnosis.shifts import RecordedShift
from sil.shift_diagnosis.verdict import Judged, ShiftDiagnosis, with_failures

from sil.cli import main
from sil.files.progress import Progress
from tests.support.truck_logs import truck_log


def diagnosed(log: Path, out: Path) -> tuple[int, dict]:
    code = main(["diagnose", str(log), "--out", str(out), "--quiet"])
    return code, json.loads((out / "diagnosis.json").read_text())


@pytest.mark.slow
def test_late_valves_are_found_with_what_looks_alike(late_log: Path, tmp_path: Path) -> None:
    code, found = diagnosed(late_log, tmp_path)
    assert code == 1
    assert found["verdict"] == "ambiguous"
    causes = {cause["id"]: cause for cause in found["causes"]}
    # a pulse that is late and a valve that is late are the same on this bus
    alike = {"valve_open_delay", "sensor_delay"}
    assert set(list(causes)[:2]) == alike
    shares = [cause["probability"] for cause in found["causes"]]
    # six shifts: what explains them less well is not excluded, but less than half as probable
    assert sum(shares[:2]) > 0.5 and all(2.0 * share < shares[1] for share in shares[2:])
    delay = causes["valve_open_delay"]["parameters"]["delay_s"]
    assert delay["low"] < 0.007 < delay["high"]
    # wide: 6 shifts, and pulses near kinks of the motion count less
    assert delay["high"] - delay["low"] < 0.009
    groups = [g for g in found["groups"] if alike <= set(g["causes"])]
    assert any("pressures" in text for text in groups[0]["measure"])
    assert (tmp_path / "report.html").stat().st_size > 20_000
    assert (tmp_path / "shifts.png").exists()


@pytest.mark.slow
def test_a_healthy_truck_is_consistent(nominal_log: Path, tmp_path: Path) -> None:
    code, found = diagnosed(nominal_log, tmp_path)
    assert (code, found["verdict"], found["causes"]) == (0, "consistent", [])
    assert found["probabilities"]["healthy"] > 0.5
    assert found["chi2_per_number"]["healthy"] < 1.5
    # what would not have been noticed is stated, and it is what the information says
    (timing,) = [line for line in found["findings"] if "(valve timing)" in line]
    noticed = {row["id"]: row for row in found["detectable"]}
    assert f"valve_open_delay {noticed['valve_open_delay']['size']:.2g} s" in timing
    assert 0.0005 < noticed["valve_open_delay"]["size"] < 0.02
    assert "end_stop_bounce" not in noticed


def test_of_many_causes_that_are_alike_the_likeliest_are_reported() -> None:
    causes = [cause for cause in catalogue() if cause.sign][:30]
    alike = {cause.effect.id: 0.04 for cause in causes[:20]}
    shares = alike | {causes[-1].effect.id: 0.001, "healthy": 0.001}
    judged = [Judged(SimpleNamespace(cause=cause), 0.0, 1.0) for cause in causes]
    found = ShiftDiagnosis("ambiguous", (), tuple(judged), shares, (), True, NOISE, (), {})
    assert {item.id for item in found.named} == set(alike)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("(1.0) can0 18FEF100#0102030405060708\n", "no ValveCommand (8FF1003) among 1 frame;"),
        ("", "no CAN frame; expected at least one"),
    ],
)
def test_a_log_without_commands_is_one_line(
    text: str, wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.log"
    path.write_text(text)
    assert main(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert wrong in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_log_that_is_not_whole_is_a_finding(
    nominal_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "broken.log"
    broken.write_text(nominal_log.read_text().replace("can0", "\x07", 1))
    none = ShiftDiagnosis("consistent", (), (), {}, (), True, NOISE, ("of its own",), {})
    monkeypatch.setattr(page, "judge_shifts", lambda *_: none)
    logs = [str(nominal_log), str(broken)]
    skipped = Counter[str]()
    found = page.diagnosed(logs, "nominal", (None, None), skipped, Progress("x"))
    assert skipped["that an earlier log holds, too,"] >= 4
    own, line = found.findings
    assert own == "of its own"
    assert line.startswith(f"{broken}: broken and skipped: 1, the first line 1: ")


def test_a_log_that_is_given_twice_is_refused(
    nominal_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "link.log"
    link.symlink_to(nominal_log)
    out = tmp_path / "out"
    assert main(["diagnose", str(nominal_log), str(link), "--out", str(out)]) == 2
    assert f"{link}: given twice; expected each log once" in capsys.readouterr().err


def test_shifts_that_fail_stand_first(tmp_path: Path) -> None:
    log = tmp_path / "blocked.log"
    truck_log(log, 3, 4, {"plant.mesh_force_n": 20_000.0}, nominal=True)
    code, found = diagnosed(log, tmp_path / "out")
    assert (code, found["verdict"]) == (1, "unnamed")
    assert found["findings"][0].endswith("did not reach the gear commanded")
    assert found["findings"][0] in found["headline"]


@pytest.mark.parametrize("verdict", ["consistent", "cannot_tell", "named"])
def test_nothing_beside_a_failed_shift_is_healthy(verdict: str) -> None:
    judged = ShiftDiagnosis(verdict, (), (), {}, (), True, NOISE, ("of its own",), {})
    found = with_failures(judged, 2)
    assert found.verdict == ("named" if verdict == "named" else "unnamed")
    assert found.findings == ("2 shifts did not reach the gear commanded", "of its own")
    assert with_failures(judged, 0) is judged


@pytest.mark.parametrize("is_best", [True, False])
def test_a_healthy_truck_is_drawn_once(is_best: bool) -> None:
    time_s = np.array([0.0, 0.01, 0.02])
    shift = RecordedShift("a.log", 0.0, "N", "B", (), time_s, time_s, 0.0, 0.0)
    linear = SimpleNamespace(misfit=np.array([1.0]), residuals=[np.zeros(3)])
    healthy, late = (
        SimpleNamespace(name=name, fit=SimpleNamespace(linear=linear))
        for name in ("healthy", "late")
    )
    best = healthy if is_best else late
    found = SimpleNamespace(shifts=(shift,), healthy=healthy, best=best)
    (stack,) = page.shifts_figure(found).stacks  # type: ignore[arg-type]
    drawn = [series.label for series in stack.panels[0].series]
    assert drawn == ["recorded", "healthy truck", *(() if is_best else ("late",))]
