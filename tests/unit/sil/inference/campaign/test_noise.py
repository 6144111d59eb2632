"""Noise of channels estimated from the record, at any rate."""

from __future__ import annotations

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from sil.campaign.campaign import Campaign, load_campaign, write_record
from sil.inference.campaign.checks import observed
from sil.inference.campaign.noise import noise_of


def changed(clean: Campaign, folder, every: int, change) -> Campaign:
    """Two strokes of a campaign, every k-th sample, each column changed."""
    for stroke in clean.strokes[:2]:
        record = clean.record(stroke)
        columns = {name: change(name, values[::every]) for name, values in record.columns.items()}
        write_record(folder / stroke.file, columns)
    text = (clean.folder / "campaign.toml").read_text(encoding="utf-8")
    head, *strokes = text.split("[[stroke]]")
    (folder / "campaign.toml").write_text("[[stroke]]".join([head, *strokes[:2]]), "utf-8")
    return load_campaign(folder)


@pytest.mark.parametrize("every", [1, 10, 40])
def test_usual_noise_stays_nominal_and_larger_noise_is_measured(clean, tmp_path, every) -> None:
    rng = np.random.default_rng(5)

    def noisier(name: str, values: np.ndarray) -> np.ndarray:
        return (
            values + rng.normal(0.0, 1200.0, len(values)) if name.startswith("pressure") else values
        )

    plain = changed(clean, tmp_path, every, lambda _name, values: values)
    strokes, findings = observed(plain, load())
    assert findings == [] and all(c.noise.uncertainty == 0.0 for c in strokes[0].channels)
    strokes, findings = observed(changed(clean, tmp_path, every, noisier), load())
    (gauge, *_) = [c for c in strokes[0].channels if c.kind == "pressure"]
    assert gauge.noise.sd == pytest.approx(1240.0, rel=0.05 + 2.0 * gauge.noise.uncertainty)
    assert any("noise of" in str(item) and "estimated" in str(item) for item in findings)


@pytest.mark.parametrize("name", ["position_m", "position_internal_m"])
def test_a_reversed_sign_is_said_as_such(clean, tmp_path, name) -> None:
    campaign = changed(clean, tmp_path, 1, lambda own, values: -values if own == name else values)
    with pytest.raises(InputError, match=f"{name}: .* sign is reversed .state scale = -1") as error:
        observed(campaign, load())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("count", [250, 500, 2000])
def test_the_noise_of_a_short_record_is_not_underestimated(count: int) -> None:
    rng = np.random.default_rng(3)
    path = 50.0 * np.sin(0.05 * np.arange(count))
    found = [noise_of(path + rng.normal(0.0, 2.0, count)) for _ in range(40)]
    # the quietest of eight bands alone would give 0.63 of it with 250 samples
    assert np.mean(found) == pytest.approx(2.0, rel=0.16)
    assert np.mean(found) > 1.7


def test_motion_in_a_part_of_the_spectrum_is_not_taken_for_noise() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(4000)
    vibration = 10.0 * np.sin(0.6 * np.pi * t)
    assert noise_of(vibration + rng.normal(0.0, 1.0, len(t))) == pytest.approx(1.0, rel=0.1)


def test_uneven_instants_are_not_taken_for_noise() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(4000) + rng.uniform(-0.3, 0.3, 4000)
    values = 1000.0 * np.sin(0.03 * t) + rng.normal(0.0, 1.0, len(t))
    assert noise_of(values, 0.01 * t) == pytest.approx(1.0, rel=0.1)
    assert noise_of(values) > 2.0
