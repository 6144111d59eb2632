"""From logs to a diagnosis: what is hidden is found, a healthy truck is not accused."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from sil.inference.truck import diagnosis
from sil.inference.truck.diagnosis import TruckDiagnosis, judge, shifts_of_truck
from sil.inference.truck.page import as_json
from sil.log_replay.recorded_shifts import RecordedShift
from tests.support.truck_logs import drawn_set, same_but


def of(paths: list[str]) -> TruckDiagnosis:
    parameters = load("nominal")
    shifts, broken = shifts_of_truck(paths, parameters, (None, None), Counter())
    return judge(shifts, parameters, broken)


WAITS = {"controller": {"shift": {"wait_for_sync": True}}}
HEALTHY = {
    "barriers of 800 and 1,100 N": [
        WAITS | {"plant": {"mesh_force_n": force}, "sensor": {"phase_s": phase}}
        for force, phase in ((800.0, 0.002), (800.0, 0.005), (1100.0, 0.0083))
    ],
    "heavy cones": [{"driveline": {"impulse_forward_n_s": i}} for i in (40.0, 255.0, 400.0, 20.0)],
    "a supply of its own on every trip": [
        {"driveline": {"impulse_forward_n_s": 40.0}, "plant": {"supply_pressure_pa": supply}}
        for supply in (7e5, 8.2e5, 9.5e5)
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HEALTHY)
def test_what_differs_between_shifts_of_a_healthy_truck_is_no_fault(
    name: str, tmp_path: Path
) -> None:
    found = of(same_but(tmp_path, 1, HEALTHY[name]))
    assert found.kind == "consistent"
    assert found.verdict is not None and found.verdict.healthy.fit.mounted


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "shifts"), [(21, None), (22, None), (3002, 12)])
def test_drawn_healthy_trucks_are_not_accused(
    seed: int, shifts: int | None, tmp_path: Path
) -> None:
    assert of(drawn_set(tmp_path, seed, shifts=shifts)).kind == "consistent"


@pytest.mark.slow
def test_a_coil_that_is_40_k_warm_is_named_on_a_gearbox(tmp_path: Path) -> None:
    warm = {"sensor.coil_temperature_k": 333.15, "sensor.measured_temperature_k": 293.15}
    found = of(drawn_set(tmp_path, 33, warm, 6))
    assert found.kind == "named" and found.verdict is not None
    (item,) = found.verdict.causes
    cause = item.fit.cause
    assert cause is not None and (cause.id, item.fit.mounted) == ("sensor_temperature", True)
    low, high = sorted(cause.value(size) for size in item.interval or ())
    assert low - 2.0 < 40.0 < high + 2.0


@pytest.mark.slow
def test_failing_shifts_of_a_leak_are_evidence(tmp_path: Path) -> None:
    found = of(drawn_set(tmp_path, 42, {"effect.piston_leak.cda_m2": 2e-6}, 8))
    assert found.failed == 7
    assert found.kind not in ("consistent", "cannot_tell")
    assert found.findings[0] == "7 shifts did not reach the gear commanded"


def test_too_few_shifts_cannot_tell(shifts: list[RecordedShift]) -> None:
    found = judge(shifts[:2], load("nominal"))
    assert (found.kind, found.verdict) == ("cannot_tell", None)
    assert found.findings == ("2 usable shifts; at least 3 are needed to judge",)


def test_shifts_that_begin_between_gears_are_no_healthy_trucks() -> None:
    found = judge([], load("nominal"), astray=2)
    assert (found.kind, found.failed, found.verdict) == ("unnamed", 2, None)
    values = as_json(found, ["truck.log"], {})
    text = "Something is wrong: 2 shifts began with the stay between gears; too few shifts to tell why."
    assert values["headline"] == text


@pytest.mark.parametrize(("failed", "astray"), [(2, 0), (0, 1)])
def test_two_shifts_that_fail_are_judged(
    shifts: list[RecordedShift], monkeypatch: pytest.MonkeyPatch, failed: int, astray: int
) -> None:
    failing = [replace(shift, failed=k < failed) for k, shift in enumerate(shifts[:2])]
    monkeypatch.setattr(
        diagnosis.Search,
        "run",
        lambda self, show: [replace(self.fitters[True].start(), evidence=0.0)],
    )
    monkeypatch.setattr(diagnosis, "detectable_of", lambda *_: [])
    monkeypatch.setattr(diagnosis.Fitter, "deviating", lambda *_: 0)
    found = judge(failing, load("nominal"), astray=astray)
    assert (found.kind, found.failed) == ("unnamed", failed + astray)


def test_a_log_that_is_not_whole_is_a_finding(nominal_log: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.log"
    broken.write_text(nominal_log.read_text().replace("can0", "\x07", 1))
    skipped = Counter[str]()
    shifts, broken_text = shifts_of_truck(
        [str(nominal_log), str(broken)], load("nominal"), (None, None), skipped
    )
    assert shifts
    assert skipped["that an earlier log holds, too,"] >= 4
    (line,) = broken_text
    assert line.startswith(f"{broken}: broken and skipped: 1, the first line 1: ")


def test_a_log_that_is_given_twice_is_refused(nominal_log: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.log"
    link.symlink_to(nominal_log)
    with pytest.raises(InputError, match=r"link\.log: given twice; expected each log once"):
        of([str(nominal_log), str(link)])
