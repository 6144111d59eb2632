"""Driving forces that are late or early against the position: told, or taken off within a step."""

from __future__ import annotations

import numpy as np
import pytest

from sil.inference.force.delay import sooner
from sil.inference.force.diagnosis import ForceDiagnosis
from sil.inference.force.record import read_motion
from tests.support.force_rig import HEAD, changed, diagnose_force, rig, written
from tests.support.held_bodies import draw_held

PRESSED = HEAD + "[body]\npiston_area_m2 = 1e-4\n"


def told_s(found: ForceDiagnosis) -> float:
    """Return the delay that forbids conclusions [s], late positive."""
    assert found.as_json()["verdict"] == "cannot_tell"
    (text,) = [line for line in found.doubts if "against the position" in line]
    stated = float(text.split("delay_s = ")[1].split()[0])
    assert ("late" if stated > 0.0 else "early") in text
    return stated


@pytest.mark.parametrize("steps", [-100, 5, 250])
def test_a_delay_is_told_within_a_step(tmp_path, steps) -> None:
    found = diagnose_force(changed(rig(tmp_path / "a"), "f", lambda f: np.roll(f, steps)))
    assert told_s(found) == pytest.approx(steps / 500.0, abs=0.5 / 500.0)


@pytest.mark.parametrize("change", [{"per_pa": 3e-5}, {"stribeck_n": 25.0}], ids=str)
def test_a_cause_does_not_make_up_for_a_part_of_a_delay(tmp_path, change) -> None:
    found = diagnose_force(changed(rig(tmp_path / "a", **change), "f", lambda f: np.roll(f, 100)))
    assert told_s(found) == pytest.approx(0.2, abs=1.0 / 500.0)


def test_a_delay_that_hides_in_the_noise_and_changes_no_cause_is_a_finding(tmp_path) -> None:
    folder = rig(tmp_path / "a", stribeck_n=25.0)
    found = diagnose_force(changed(folder, "f", lambda f: np.roll(f, 2)))
    assert found.verdict == "named" and found.leader.ids == ("stribeck",)
    assert any("is 0.004 s late against the position: correct" in line for line in found.findings())


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.slow
def test_pressures_are_late_with_the_force_or_not(tmp_path, both) -> None:
    rng = np.random.default_rng(2)
    folder = rig(tmp_path / "a", head=PRESSED)
    t = np.arange(10000) / 500.0
    p = 4e5 + 2e5 * np.sin(1.3 * t) + rng.normal(0.0, 300.0, len(t))
    changed(folder, "f", lambda f: np.roll(f - 1e-4 * p, 40))
    changed(folder, "pressure_pa", lambda _: np.roll(p, 40 if both else 0))
    found = diagnose_force(folder)
    assert told_s(found) == pytest.approx(0.08, abs=1.0 / 500.0)
    assert found.doubts[0].startswith(
        f"the driving force {'with its pressures ' if both else ''}is 0.08 s late"
    )


def test_a_delay_of_one_half_of_the_record_is_none(tmp_path) -> None:
    late = np.arange(10000) > 5000
    folder = changed(rig(tmp_path / "a"), "f", lambda f: np.where(late, np.roll(f, 20), f))
    assert not any("against the position" in line for line in diagnose_force(folder).findings())


def test_what_a_moved_force_lacks_at_the_ends_is_not_judged(tmp_path) -> None:
    record = read_motion(rig(tmp_path / "a", head=PRESSED))
    for steps in (-50, 50):
        moved = sooner(record, steps / 500.0, pressures=False)
        lacking = record.judged & ~moved.judged
        rows = np.arange(len(lacking))
        inside = (rows >= 150) & (rows < len(rows) - 150)
        assert lacking.any() and not (lacking & inside).any()
        assert moved.recorded_n[inside] == pytest.approx(np.roll(record.recorded_n, -steps)[inside])
        added = 1e-4 * record.raw.pressure_pa
        assert moved.raw.force_n - moved.recorded_n == pytest.approx(added)


@pytest.mark.parametrize("steps", [-0.5, 0.5])
def test_a_force_half_a_sampling_step_off_is_moved(tmp_path, steps) -> None:
    t = (np.arange(10000) - steps) / 500.0
    v = 0.21 * np.cos(2.1 * t) + 0.228 * np.cos(5.7 * t)
    force = 20.0 * (-0.441 * np.sin(2.1 * t) - 1.2996 * np.sin(5.7 * t)) + 15.0 * np.sign(v)
    force += 80.0 * v + np.random.default_rng(1).normal(0.0, 0.01, len(t))
    folder = changed(rig(tmp_path / "a"), "f", lambda f: force)
    t += steps / 500.0
    exact = 100.0 * np.sin(2.1 * t) + 40.0 * np.sin(5.7 * t)
    found = diagnose_force(changed(folder, "x_mm", lambda x: exact + 0.01 * (x - exact)))
    assert found.verdict == "consistent" and found.plain.over_noise < 1.25
    (text,) = [line for line in found.findings() if "within a sampling step" in line]
    assert float(text.split()[4]) == pytest.approx(0.001, rel=0.02)
    assert ("late" if steps > 0 else "early") in text


def test_a_pressure_that_drives_is_moved_with_the_force_in_each_file(tmp_path) -> None:
    t = np.arange(5000) / 500.0
    s = t - 0.001
    v = 0.21 * np.cos(2.1 * s) + 0.228 * np.cos(5.7 * s)
    a = -0.441 * np.sin(2.1 * s) - 1.2996 * np.sin(5.7 * s)
    force = 20.0 * a + 15.0 * np.sign(v) + 80.0 * v
    noise = np.random.default_rng(1).normal(0.0, 1.0, (2, len(t)))
    x = 0.1 * np.sin(2.1 * t) + 0.04 * np.sin(5.7 * t) + 1e-8 * noise[0]
    pressure = (force + 0.01 * noise[1]) / 1e-3
    folder = written(tmp_path / "a", "piston_area_m2 = 1e-3", position_m=x, pressure_pa=pressure)
    (folder / "b.csv").write_bytes((folder / "a.csv").read_bytes())
    with (folder / "campaign.toml").open("a", encoding="utf-8") as file:
        file.write('[[stroke]]\nfile = "b.csv"\n')
    found = diagnose_force(folder)
    assert any("within a sampling step" in line for line in found.findings())
    raw = found.record.raw
    assert raw.pressure_pa is not None and list(found.record.starts) == [0, 5000]
    assert 1e-3 * raw.pressure_pa == pytest.approx(raw.force_n)
    assert np.ptp(raw.force_n[:5000] - raw.force_n[5000:]) == 0.0  # nothing crosses the joint
    assert np.median(np.abs(raw.pressure_pa[:5000] - pressure)) > 10.0  # moved at all


@pytest.mark.parametrize(("seed", "uneven"), [(0, 5.0), (9203, 1.0), (9227, 1.0), (9236, 5.0)])
def test_plain_bodies_under_a_held_force_are_consistent(tmp_path, seed, uneven) -> None:
    draw_held(tmp_path / "a", seed, uneven)
    found = diagnose_force(tmp_path / "a")
    assert found.verdict == "consistent" and not found.leader.groups
    (text,) = [line for line in found.findings() if "within a sampling step" in line]
    assert f"is {0.5 * found.record.step_s:.3g} s early" in text
