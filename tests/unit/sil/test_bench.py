"""The bench's own equations and its judgement of accuracy: a ratio is worth what they are worth."""

from __future__ import annotations

import numpy as np
import pytest

from plant.batch.prediction import Predictor
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel.layout import FixedState
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import simulate
from tests.bench.__main__ import main
from tests.bench._contest import accurate, cheapest, errors
from tests.bench._piston import Piston, Shown, solve_with_scipy
from tests.bench.integrator import OPENING_S, TIMES

CONDITIONS = StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),))


def test_the_peers_equations_are_ours() -> None:
    stroke = simulate(load(), CONDITIONS, TIMES, tolerance=1e-10, internal=False)
    piston = Piston.of(make_setup(load(), CONDITIONS))
    switches = [(OPENING_S, 0, 1)]
    assert stroke.impact is not None
    ours = Shown(
        stroke.impact.time_s,
        stroke.impact.speed_m_s,
        stroke.states[:, FixedState.p_1 : FixedState.p_2 + 1],
    )
    for begin_s in (0.0, OPENING_S):
        theirs = solve_with_scipy(piston, switches, TIMES, "DOP853", 1e-10, begin_s)
        late, speed, pressure = errors([ours], [theirs])
        assert late < 1e-9 and speed < 1e-7 and pressure < 0.1
    assert np.ptp(ours.pressures_pa) > 5e5
    predictor = Predictor(np.rint(TIMES * 1e9).astype(np.int64))
    predictor.states(make_setup(load(), CONDITIONS))
    assert predictor.happened[-1, 0] == pytest.approx(ours.impact_s, abs=1e-8)


def test_a_stroke_that_turns_back_and_one_that_never_arrives() -> None:
    piston = Piston.of(make_setup(load(), CONDITIONS))
    # the small final volume stops it once on the way; a heavy load holds it for ever
    braked = piston._replace(v20=piston.stroke * piston.a2 + 2e-6)
    shown = solve_with_scipy(braked, [(OPENING_S, 0, 1)], TIMES, "RK45", 1e-7)
    assert shown.impact_s > 0.036
    held = piston._replace(static=1e6, run=1e6)
    with pytest.raises(RuntimeError, match="does not arrive"):
        solve_with_scipy(held, [(OPENING_S, 0, 1)], TIMES)


def test_the_cheapest_setting_is_the_first_that_is_accurate() -> None:
    exact = Shown(0.03, 1.0, np.full((4, 2), 1e5))

    def solve(setting: float) -> list[Shown]:
        if setting > 1.0:
            raise RuntimeError("too loose to arrive")
        return [Shown(0.03 + setting * 1e-5, 1.0, exact.pressures_pa + setting)]

    setting, worst = cheapest(solve, (2.0, 1.0, 0.05, 0.01), [exact])
    assert setting == 0.05
    assert worst == pytest.approx((5e-7, 0.0, 0.05))
    assert not accurate((float("nan"), 0.0, 0.0))
    with pytest.raises(RuntimeError, match="accurate"):
        cheapest(solve, (1.0,), [exact])


def test_unknown_measurements_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nothing"]) == 2
    assert "integrator" in capsys.readouterr().err
