"""What a truck's diagnosis writes: diagnosis.json, extended_model.toml, report.html."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sil.cli import main
from sil.inference.truck.detectable import Detectable
from sil.inference.truck.diagnosis import TruckDiagnosis
from sil.inference.truck.fit import Fit, Fitter
from sil.inference.truck.page import as_json, extended_model, shifts_figure, write_files
from sil.inference.truck.verdict import Hypothesis, Verdict
from sil.log_replay.recorded_shifts import RecordedShift
from tests.unit.sil.inference.truck.test_causes import only


@pytest.fixture
def healthy(fitter: Fitter, usual: Fit) -> Fit:
    return replace(usual, evidence=-100.0, unit_sd=np.ones(len(fitter.layout)))


def diagnosis_of(
    kind: str, fits: list[Fit], fitter: Fitter, shifts: list[RecordedShift]
) -> TruckDiagnosis:
    """Return a diagnosis of fits, the likeliest first; all causes among them are reported."""
    hypotheses = tuple(Hypothesis(fit, 0.8 - 0.3 * k, (1.0, 3.0)) for k, fit in enumerate(fits))
    causes = tuple(item for item in hypotheses if item.fit.cause)
    shares = {item.fit.id: item.probability for item in hypotheses}
    late, slow = only("valve_open_delay"), only("sensor_delay")
    shown = (Detectable(late, 1.0, ("sensor_delay",)), Detectable(slow, None, ()))
    verdict = Verdict(kind, hypotheses, shares, causes, ())
    return TruckDiagnosis(
        kind, tuple(shifts), ("of its own",), 1.4e-5, verdict, {True: fitter}, shown
    )


def test_a_named_cause_is_a_model_and_a_page(
    fitter: Fitter, healthy: Fit, shifts: list[RecordedShift], tmp_path: Path
) -> None:
    late = replace(healthy, cause=only("valve_open_delay"), size=2.0, evidence=-80.0)
    found = diagnosis_of("named", [late, healthy], fitter, shifts)
    values = as_json(found, ["a.log", "b.log"], {"with too few pulses": 2})
    (cause,) = values["causes"]
    assert cause["id"] == "valve_open_delay" and cause["probability"] == 0.8
    assert cause["parameters"]["delay_s"] == {
        "value": pytest.approx(0.006), "low": pytest.approx(0.003), "high": pytest.approx(0.009), "unit": "s",
    }  # fmt: skip
    assert cause["evidence"].endswith("gains 20.0 in log evidence")
    noisier = diagnosis_of("named", [late, replace(healthy, noise_factor=2.0)], fitter, shifts)
    (cause,) = as_json(noisier, ["a.log"], {})["causes"]
    assert "falls from 2.00 to 1.00 times the expected one" in cause["evidence"]
    assert values["headline"] == "Valves open 6.0 ms late (3.0 to 9.0 ms)."
    assert values["campaign"] == "a.log and 1 more"
    assert values["rivals"] == [["sensor_delay", "valve_open_delay"]]
    assert "2 shifts with too few pulses left out" in values["findings"]
    assert "would not have been noticed at any size: sensor_delay" in values["findings"]
    assert [row["id"] for row in values["detectable"]] == ["valve_open_delay"]
    write_files(found, values, tmp_path, "nominal", "opc4 diagnose a.log b.log")
    model = tomllib.loads((tmp_path / "extended_model.toml").read_text())
    assert model["base"]["model"] == "nominal"
    assert model["effect"]["valve_open_delay"]["delay_s"]["value"] == pytest.approx(0.006)
    assert (tmp_path / "shifts.png").exists()
    assert "log evidence behind" in (tmp_path / "report.html").read_text()


def test_a_healthy_truck_is_drawn_once_and_says_what_would_have_been_seen(
    fitter: Fitter, healthy: Fit, shifts: list[RecordedShift], tmp_path: Path
) -> None:
    found = diagnosis_of("consistent", [healthy], fitter, shifts)
    drawn = [series.label for series in shifts_figure(found).stacks[0].panels[0].series]
    assert drawn == ["recorded", "healthy truck"]
    values = as_json(found, ["a.log"], {})
    assert values["headline"] == "Nothing found. A delay above 3.0 ms would have been seen."
    assert values["causes"] == [] and values["extended_model"] is None
    write_files(found, values, tmp_path, "nominal", "opc4 diagnose a.log")
    assert not (tmp_path / "extended_model.toml").exists()


def test_failed_shifts_stand_before_a_cause(
    fitter: Fitter, healthy: Fit, shifts: list[RecordedShift]
) -> None:
    failing = [replace(shifts[0], failed=True), *shifts[1:]]
    late = replace(healthy, cause=only("valve_open_delay"), size=2.0)
    found = diagnosis_of("named", [late, healthy], fitter, failing)
    assert as_json(found, ["a.log"], {})["headline"].startswith("1 shift failed. Valves open")
    found = replace(diagnosis_of("unnamed", [healthy], fitter, failing), kind="unnamed")
    said = as_json(found, ["a.log"], {})["headline"]
    assert said == "Something is wrong: of its own; no cause of the catalogue explains it."
    said = as_json(replace(found, shifts=tuple(failing[:2])), ["a.log"], {})["headline"]
    assert said == "Something is wrong: of its own; too few shifts to tell why."


def test_what_a_variant_fixes_is_in_the_model(
    fitter: Fitter, healthy: Fit, shifts: list[RecordedShift]
) -> None:
    bump = replace(healthy, cause=only("friction_bump"), size=2.0)
    text = extended_model(diagnosis_of("named", [bump, healthy], fitter, shifts), "nominal")
    assert "[effect.friction_bump]" in text and "200.0" in text and "0.003" in text


def test_too_few_shifts_are_a_page(
    nominal_log: Path, tmp_path: Path, shifts: list[RecordedShift]
) -> None:
    found = TruckDiagnosis("cannot_tell", tuple(shifts[:2]), ("2 usable shifts",))
    values = as_json(found, [str(nominal_log)], {})
    assert values["headline"] == "These data cannot tell: 2 usable shifts."
    assert values["probabilities"] == {} and values["truck"] == []
    write_files(found, values, tmp_path, "nominal", "opc4 diagnose a.log")
    assert "2 usable shifts" in (tmp_path / "report.html").read_text()


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


@pytest.mark.slow
def test_the_command_writes_all_of_it(nominal_log: Path, tmp_path: Path) -> None:
    assert main(["diagnose", str(nominal_log), "--out", str(tmp_path), "--quiet"]) == 0
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert (found["verdict"], found["causes"]) == ("consistent", [])
    assert found["probabilities"]["healthy"] > 0.5
    assert found["headline"].startswith("Nothing found.")
    assert (tmp_path / "report.html").stat().st_size > 20_000
