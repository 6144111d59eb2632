"""A user's own effect in runs and studies: on every transport, in workers, and run again as it was."""

from __future__ import annotations

import json
import shutil

import pytest

from tests.conftest import ROOT

SEAL = ROOT / "tests" / "unit" / "plant" / "effects" / "end_seal.py"
GIVEN = ("--effects", "mine.py", "--set", "effect.end_seal.length_m=0.002")
STUDY = """
name = "sticking"
effects = ["mine.py"]
[stroke]
kind = "N-B"
commands = [[0.01, "B", 0.98]]
until_s = 0.1
[[sweep]]
path = "effect.end_seal.force_n"
values = [0.0, 30.0, 60.0]
[[variant]]
name = "short"
set = { "effect.end_seal.length_m" = 0.002 }
"""


@pytest.fixture
def mine(tmp_path):
    return shutil.copy(SEAL, tmp_path / "mine.py")


def test_a_run_has_the_effect_and_runs_again_as_it_was(opc4, mine, tmp_path) -> None:
    force = ("--set", "effect.end_seal.force_n=400")
    hashes = []
    for more in (("lab_n_b",), ("lab_n_b", *GIVEN, *force), ("out1/result.json",)):
        out = f"out{len(hashes)}"
        done = opc4("run", *more, "--no-report", "--json", "--out", out)
        assert done.returncode in (0, 1), done.stderr
        hashes.append(json.loads(done.stdout)["trace_sha256"])
    assert hashes[0] != hashes[1] == hashes[2]
    (tmp_path / "mine.py").write_text(SEAL.read_text(encoding="utf-8") + "# changed\n")
    done = opc4("run", "out1/result.json", "--no-report")
    assert done.returncode == 2 and "mine.py: has changed: sha256" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_participants_in_processes_load_it(opc4, mine) -> None:
    command = ("run", "lab_n_b", *GIVEN, "--set", "effect.end_seal.force_n=400", "--no-report")
    hashes = set()
    for transport in ("inproc", "local"):
        done = opc4(*command, "--transport", transport, "--json", "--out", transport)
        hashes.add(json.loads(done.stdout)["trace_sha256"])
    assert len(hashes) == 1


@pytest.mark.slow
def test_a_study_sweeps_it_in_workers(opc4, mine, tmp_path) -> None:
    (tmp_path / "sticking.toml").write_text(STUDY, encoding="utf-8")
    for workers in ("1", "2"):
        done = opc4("whatif", "sticking.toml", "--workers", workers, "--out", f"sweep{workers}")
        assert done.returncode == 0, done.stderr
    tables = [(tmp_path / f"sweep{n}" / "results.csv").read_text() for n in (1, 2)]
    assert tables[0] == tables[1]
    rows = [line.split(",") for line in tables[0].splitlines()]
    speeds = [float(row[rows[0].index("impact_speed_m_s")]) for row in rows[1:]]
    assert speeds[0] > speeds[1] + 0.01 > speeds[2] + 0.02


@pytest.mark.parametrize("command", [("run", "lab_n_b"), ("whatif", "closed_chamber")])
def test_a_bad_file_is_one_line(opc4, tmp_path, command) -> None:
    (tmp_path / "mine.py").write_text("(\n", encoding="utf-8")
    done = opc4(*command, "--effects", "mine.py")
    assert done.returncode == 2 and "mine.py:1: not valid Python: '(' was never" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


CAMPAIGN = """
name = "plan"
rig = "length"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 1000.0
[[stroke]]
file = "one.csv"
label = "N-B"
kind = "N-B"
supply_pressure_pa = 900000.0
load = "none"
rest_s = 60.0
commands = [[0.01, "B", 0.98]]
charged_before = []
"""
AT_61 = "    if values['force_n'] == 61.0:\n        values['none']\n    grip.add"
NOT_A_NUMBER = (
    "    if 0.007 < position_m < 0.0075:\n        force_n = end_m / (end_m - end_m)\n    left_m"
)


@pytest.mark.parametrize(
    ("old", "new", "code", "message"),
    [
        (
            "    grip.add",
            AT_61,
            2,
            "mine.py:28: KeyError: 'none'; expected no error at force_n=61, ",
        ),
        ("    left_m", NOT_A_NUMBER, 3, "one.csv: integration stopped after 0.04"),
    ],
)
def test_what_shows_only_in_a_stroke_is_one_line(opc4, tmp_path, old, new, code, message) -> None:
    (tmp_path / "mine.py").write_text(SEAL.read_text(encoding="utf-8").replace(old, new, 1))
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan" / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    done = opc4("simulate", "plan", *GIVEN, "--set", "effect.end_seal.force_n=61", "--quiet")
    assert done.returncode == code and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
