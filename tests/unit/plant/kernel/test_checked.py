"""The kernels as plain Python on views that check every bound give the strokes of the compiled ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np

from plant.batch.batch import Strokes, simulate_batch
from plant.batch.prediction import Predictor
from plant.effects import effect
from plant.parameters import load
from plant.systems.setup import make_setup
from tests.physics.strokes import ALL, conditions_of

STROKES = ("fixed", "fixed compressible", "N-B charged")
IN_LANES = ("fixed", "N-B")


def states_of_short_strokes() -> dict[str, list[float]]:
    """Last states of strokes of 25 ms by the scalar kernel, and of two by the lanes."""
    states = {}
    for name in STROKES:
        setup = make_setup(load(), conditions_of(ALL[name]))
        predictor = Predictor(np.array([0, 25_000_000]), tolerance=1e-5)
        states[name] = predictor.states(setup)[-1].tolist()
    setup = make_setup(load(), conditions_of(ALL["fixed"]))
    effect("leak_to_atmosphere").apply(setup, {"cda_m2": 2e-6, "where": 2.0})
    assert setup.p.adder != 0.0
    predictor = Predictor(np.array([0, 25_000_000]), tolerance=1e-5)
    states["fixed with an added term"] = predictor.states(setup)[-1].tolist()
    for name in IN_LANES:
        setup = make_setup(load(), conditions_of(ALL[name]))
        result = simulate_batch(Strokes.from_setups([setup], 0.022), tolerance=1e-4)
        assert result.in_lanes.all() and not result.status.any()
        states[f"{name} in a lane"] = result.final[0].tolist()
    return states


def test_checked_kernels_give_the_same_strokes() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.unit.plant.kernel.test_checked"],
        env={**os.environ, "OPC4_CHECKED_KERNELS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == states_of_short_strokes()


if __name__ == "__main__":
    print(json.dumps(states_of_short_strokes()))
