"""The reported position: prediction from the true one against the chain itself."""

from __future__ import annotations

import numpy as np
import pytest

from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup
from sil.inference.campaign.observations import internal_prediction, internal_samples
from tests.support.made_campaign import conditions_of

TIME_S = np.arange(3001) * 1e-4


def stroke_of(change, phase_s: float):
    setup = make_setup(load(), conditions_of("N-B", 900000.0))
    setup.phase_s = phase_s
    change(setup)
    return setup, run_setup(setup, TIME_S)


@pytest.mark.parametrize("phase_s", [0.0, 0.0031, 0.0098])
def test_published_values_follow_without_knowing_the_phase(phase_s: float) -> None:
    setup, stroke = stroke_of(lambda s: None, phase_s)
    samples = internal_samples(TIME_S, stroke.internal_m)
    assert samples is not None
    predicted = internal_prediction(samples, TIME_S, stroke.position_m, setup)
    assert np.abs(predicted - samples.values_m).max() < 4.5e-5


def test_gain_clock_and_heat_change_the_prediction_as_the_chain() -> None:
    from plant.effects import CATALOGUE

    for name, values in (
        ("sensor_gain", {"gain": 0.05}),
        ("sensor_temperature", {"difference_k": 30.0}),
        ("clock_skew", {"offset_s": 0.004, "drift": 0.02}),
        ("sensor_delay", {"delay_s": 0.006}),
    ):
        setup, stroke = stroke_of(lambda s, n=name, v=values: CATALOGUE[n].apply(s, v), 0.004)
        samples = internal_samples(TIME_S, stroke.internal_m)
        assert samples is not None
        own = internal_prediction(samples, TIME_S, stroke.position_m, setup)
        nominal, _stroke = stroke_of(lambda s: None, 0.004)
        healthy = internal_prediction(samples, TIME_S, stroke.position_m, nominal)
        wrong = np.abs(healthy - samples.values_m).max()
        assert np.abs(own - samples.values_m).max() < min(6e-5, 0.5 * wrong), name


def test_a_sensor_that_never_moves_is_left_out() -> None:
    assert internal_samples(TIME_S, np.zeros(len(TIME_S))) is None
