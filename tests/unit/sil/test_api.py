"""The Python interface gives what the commands give."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sil
from can_dbc.errors import InputError
from sil import api
from sil.cli import main
from tests.conftest import ROOT

PLAN = """
name = "plan"
rig = "length"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 10000.0
[[stroke]]
file = "stroke_001.csv"
label = "N-B"
kind = "N-B"
load = "none"
rest_s = 60.0
charged_before = []
supply_pressure_pa = 900000.0
commands = [[0.02, "B", 0.98], [0.2, "B", 0.0]]
"""


def test_run_returns_checks_signals_and_frames() -> None:
    found = api.run("lab_n_b", {"controller.filter": False})
    assert found.signals["position_m"].max() == pytest.approx(0.01285)
    assert len(found.estimate[0]) == len(found.estimate[1]) > 10
    assert len(found.frames) == found.metrics["frames"] > 100
    assert repr(found).startswith("Run(failed, 21 of 25 checks met, 1 shift in 51.1")
    assert len(repr(found)) < 120 and found.warnings == []


def test_run_takes_a_table() -> None:
    table = {"name": "t", "duration_s": 0.3, "request": [{"at_s": 0.1, "gear": "backward"}]}
    assert api.run(table, {"valve.D_fall": np.float64(0.02)}).shifts[0].to_gear == "backward"


def test_bad_input_is_raised() -> None:
    with pytest.raises(InputError, match="expected one of lab_n_f, lab_n_b"):
        api.run("lab_n_x")
    with pytest.raises(InputError, match="no such value"):
        api.run("lab_n_b", {"valve.D_fell": 1.0})


def test_simulate(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text(PLAN)
    slow, nominal = (
        api.simulate(tmp_path, settings)[0] for settings in ({"friction_length.F_rf_p": 80.0}, {})
    )
    assert slow.arrival_s > nominal.arrival_s + 1e-4
    assert nominal.impact_speed_m_s == pytest.approx(0.94, abs=0.02)


def test_whatif_and_replay(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "s.toml").write_text(
        'name = "s"\nscenario = "lab_n_b"\n[[sweep]]\npath = "valve.D_rise"\nvalues = [0.004, 0.008]\n'
    )
    times = api.whatif(tmp_path / "s.toml", out=tmp_path / "out").numbers["shift_time_s"]
    assert times[1] - times[0] == pytest.approx(0.004, abs=1e-6)
    with pytest.raises(InputError, match="model 'nominl': no such parameter set"):
        api.whatif(tmp_path / "s.toml", out=tmp_path / "none", model="nominl")
    assert main(["run", "lab_n_b", "--no-report", "--out", str(tmp_path / "run")]) == 0
    assert not api.replay(tmp_path / "run" / "bus.log").differs
    changed = api.replay(tmp_path / "run" / "bus.log", {"controller.filter": False})
    assert changed.differs and "ticks that differ" in changed._repr_html_()


def test_diagnose_refuses_what_is_no_campaign(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        api.diagnose(tmp_path)


def test_importing_it_costs_nothing_heavy() -> None:
    program = (
        "import sys; from sil import run, simulate, whatif, diagnose, replay;"
        "assert not {'numpy', 'numba', 'cantools'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)


def test_no_module_of_the_package_hides_a_function() -> None:
    """A submodule, once imported, becomes an attribute of its package."""
    modules = {module.name for module in pkgutil.iter_modules(sil.__path__)}
    assert {"api", "studies", "log_replay", "simulation"} <= modules
    assert not modules & set(sil.__all__)
    for name in sil.__all__:
        assert getattr(sil, name) is getattr(api, name)
    with pytest.raises(AttributeError, match="walk"):
        _ = sil.walk


def test_signals_have_one_length() -> None:
    found = api.run("lab_n_b")
    assert len({len(v) for v in found.signals.values()}) == 1
    assert np.all(np.diff(found.signals["time_s"]) > 0.0)
