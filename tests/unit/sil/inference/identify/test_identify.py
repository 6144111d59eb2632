"""Identification recovers the truth of noisy campaigns made here, within the interval it states."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet, load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup
from sil.campaign.campaign import (
    Campaign,
    CampaignStroke,
    campaign_toml,
    load_campaign,
    write_record,
)
from sil.cli import main
from sil.inference.identify.flow import identify_flow, two_polynomials
from sil.inference.identify.whole_record import identify_records

TRUTH = {
    "friction_fixed.F_sf": 80.0,
    "friction_fixed.F_rf": 56.0,
    "friction_fixed.beta": 46.0,
    "alpha.alpha_m1": 0.97,
    "alpha.alpha_1": 0.92,
    "alpha.alpha_m2": 1.40,
    "alpha.alpha_2": 1.10,
    "damper.A_S": 2.5e-6,
    "damper.kappa_effective": 1.5e8,
}
RATE_HZ = 10000.0


def conditions(**changes: object) -> StrokeConditions:
    base = StrokeConditions("fixed", 900000.0, ((0.01, "1", 0.98), (0.2, "1", 0.0)))
    return replace(base, **changes)  # type: ignore[arg-type]


def write_campaign(
    folder: Path,
    strokes: list[StrokeConditions],
    truth: ParameterSet,
    seed: int,
    until_s: float = 0.3,
) -> Campaign:
    """A noisy campaign of these strokes; each with its own friction, delay and supply."""
    generator = np.random.default_rng(seed)
    offsets = generator.normal(0.0, 350.0, 2)
    entries = []
    for number, condition in enumerate(strokes, start=1):
        setup = make_setup(truth, condition)
        factor = 1.0 + 0.05 * generator.normal()
        for index in (Parameters.f_static_s, Parameters.f_run_s, Parameters.beta_s):
            setup.p[index] *= factor
        setup.p.p_supply *= 1.0 + 0.003 * generator.normal()
        later = round(2e5 * generator.normal())
        setup.timing = replace(setup.timing, rise_ns=setup.timing.rise_ns + later)
        time_s = np.arange(round(until_s * RATE_HZ) + 1) / RATE_HZ
        stroke = run_setup(setup, time_s, internal=False)
        steps = (stroke.position_m + 1e-5 * generator.normal(size=len(time_s))) / 5e-5
        columns = {"time_s": time_s, "position_m": np.rint(steps) * 5e-5}
        for k, name in enumerate(("1", "2")):
            noisy = (
                stroke.pressure_pa(name) + offsets[k] + 300.0 * generator.normal(size=len(time_s))
            )
            columns[f"pressure_{name}_pa"] = np.rint(noisy / 244.2) * 244.2
        if condition.load == "damper":
            oil = stroke.pressure_pa("oil2") + 1500.0 * generator.normal(size=len(time_s))
            columns["pressure_oil2_pa"] = oil
        for k, name in enumerate(("1", "2")):
            columns[f"cmd_{name}"] = stroke.duty[:, k]
        file = f"stroke_{number:03d}.csv"
        write_record(folder / file, columns)
        entries.append(CampaignStroke(file, "made here", condition))
    campaign = Campaign(folder, "made_here", "fixed", 101325.0, 293.15, RATE_HZ, tuple(entries))
    (folder / "campaign.toml").write_text(campaign_toml(campaign, entries))
    return load_campaign(folder)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    strokes = [conditions(supply_pressure_pa=p) for p in (9e5, 9e5, 7.5e5, 6e5, 6e5, 9e5)]
    return write_campaign(tmp_path_factory.mktemp("plain"), strokes, only("friction"), 5)


def only(section: str) -> ParameterSet:
    """The nominal set with one section as it is in truth."""
    return load().override({k: v for k, v in TRUTH.items() if k.startswith(section)})


def test_friction_is_recovered(plain: Campaign) -> None:
    found = identify_records("friction", plain, load())
    assert found.fits, found.judgement
    for item in found.estimates:
        assert item.low <= TRUTH[item.path] <= item.high, item
        assert item.high - item.low < 0.25 * TRUTH[item.path]


def test_exponents_are_recovered(tmp_path: Path) -> None:
    strokes = [conditions(), conditions(supply_pressure_pa=6e5)] * 2
    campaign = write_campaign(tmp_path, strokes, only("alpha"), 6)
    found = identify_records("alpha", campaign, load())
    assert found.fits, found.judgement
    for item in found.estimates:
        assert item.low <= TRUTH[item.path] <= item.high, item
        assert item.high - item.low < 0.15


def test_damper_is_recovered(tmp_path: Path) -> None:
    strokes = [conditions(load="damper"), conditions(load="damper", supply_pressure_pa=6e5)]
    campaign = write_campaign(tmp_path, strokes, only("damper"), 7)
    found = identify_records("damper", campaign, load())
    assert found.fits, found.judgement
    estimates = {item.path: item for item in found.estimates}
    for path in ("damper.A_S", "damper.kappa_effective"):
        item = estimates[path]
        assert item.low <= TRUTH[path] <= item.high, item
        assert item.high - item.low < 0.1 * TRUTH[path]


def test_a_model_that_does_not_fit_has_no_interval(tmp_path: Path, capsys) -> None:
    sticky = load().override({"friction_fixed.F_rf": 150.0, "friction_fixed.beta": 120.0})
    campaign = write_campaign(tmp_path, [conditions(load="damper")], sticky, 7)
    out = tmp_path / "found"
    command = ["identify", "damper", str(campaign.folder), "--out", str(out)]
    assert main(command) == 1
    assert "the model does not fit: residual" in capsys.readouterr().out
    assert main([*command, "--json", "--force"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["fits"] is False and found["over_noise"] > 3.0
    assert all(item["low"] is None and item["high"] is None for item in found["estimates"])
    text = (out / "model.toml").read_text(encoding="utf-8")
    assert text.startswith("# the model does not fit: residual") and "low =" not in text


def resting(volume: str) -> list[StrokeConditions]:
    """Fill and empty a volume at rest: chamber 1 at the far stop, or 2 at the near one."""
    chamber, offset_m = ("1", 0.01285) if volume == "small" else ("2", 0.0)
    fill = conditions(commands=((0.01, chamber, 0.98),), start_offset_m=offset_m)
    return [fill, replace(fill, commands=((0.01, chamber, 0.0),), charged_before=(chamber,))]


def test_flow_maps_are_recovered_and_predict_another_volume(tmp_path: Path) -> None:
    """Chamber two made three times as large is predicted from chamber one's records."""
    nominal = load()
    small = nominal.value("fixed.V10") + nominal.value("fixed.A1") * 0.01285
    wide = nominal.override({"fixed.V20": 3.0 * small})
    campaign = write_campaign(tmp_path, resting("small") + resting("large"), wide, 8, until_s=0.7)
    found = identify_flow(campaign, wide)
    assert found.fits, found.judgement
    assert not identify_flow(campaign, nominal).fits, "one of its volumes is wrong"
    identified = wide.override({e.path: list(e.value) for e in found.estimates})  # type: ignore[arg-type]
    from plant.kernel.layout import FlowMap
    from plant.kernel.packing import flow_coefficients
    from plant.parts.flow import charge, discharge

    c, true = (FlowMap(flow_coefficients(item)) for item in (identified, wide))
    for p in np.linspace(2.0e5, 8.5e5, 14):
        into, out = (charge.py_func(p, 9e5, m) for m in (c, true))
        assert into == pytest.approx(out, rel=0.02, abs=0.03)
        into, out = (discharge.py_func(p, 101325.0, m) for m in (c, true))
        assert into == pytest.approx(out, rel=0.03)
    checked = [line for line in found.notes if line.startswith("check")]
    assert any(": 3.0 times" in line for line in checked)
    for line in checked:
        assert float(line.split("rms ")[1].split()[0]) < 3000.0


def test_two_polynomials_meet_and_vanish() -> None:
    x = np.linspace(0.1, 1.0, 400)
    near, far = two_polynomials(x, 1.0 - x**3, 0.55, 4, 3)
    assert np.polyval(near[::-1], 1.0) == pytest.approx(0.0, abs=1e-10)
    assert np.polyval(near[::-1], 0.55) == pytest.approx(np.polyval(far[::-1], 0.55), abs=1e-10)
    assert np.polyval(far[::-1], 0.3) == pytest.approx(1.0 - 0.3**3, abs=1e-9)


def test_command_writes_a_model_that_loads(plain: Campaign, tmp_path: Path) -> None:
    out = tmp_path / "found"
    assert main(["identify", "friction", str(plain.folder), "--out", str(out), "--json"]) == 0
    model = load(out / "model.toml")
    assert model.value("friction_fixed.F_sf") == pytest.approx(80.0, rel=0.15)
    assert model["friction_fixed.F_sf"].low is not None
    assert (out / "friction.png").stat().st_size > 1000


def test_a_campaign_without_what_is_needed_is_refused(tmp_path: Path) -> None:
    campaign = write_campaign(tmp_path, [conditions(load="damper")], load(), 9)
    with pytest.raises(InputError, match="without load"):
        identify_records("friction", campaign, load())
    (tmp_path / "plain").mkdir()
    with pytest.raises(InputError, match="damper"):
        identify_records(
            "damper", write_campaign(tmp_path / "plain", [conditions()], load(), 9), load()
        )
