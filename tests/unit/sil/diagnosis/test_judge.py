"""Probabilities of competing explanations, in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sil.diagnosis.judge import EFFECTIVE, by_cause, weigh


def entry(score: float, beyond: float, *ids: str) -> SimpleNamespace:
    return SimpleNamespace(
        score=score,
        ids=ids,
        prior=0.1 if len(ids) > 1 else 1.0,
        whole=SimpleNamespace(beyond=beyond),
        probability=0.0,
    )


def test_close_scores_without_misfit_follow_their_evidence() -> None:
    rivals = [entry(100.0, 0.0, "a"), entry(100.5, 0.0, "b")]
    weigh(rivals)
    expected = (1.0 + 2.0 * 0.5 / EFFECTIVE) ** (-EFFECTIVE / 2.0)
    assert rivals[1].probability / rivals[0].probability == pytest.approx(expected)
    assert expected == pytest.approx(np.exp(-0.5), rel=0.05)


def test_a_model_error_makes_the_same_difference_say_less() -> None:
    sure = [entry(100.0, 0.0, "a"), entry(130.0, 60.0, "b")]
    unsure = [entry(100.0, 2000.0, "a"), entry(130.0, 2060.0, "b")]
    weigh(sure)
    weigh(unsure)
    assert sure[0].probability > 0.99
    assert 0.5 < unsure[0].probability < 0.7


def test_a_cause_collects_every_explanation_that_holds_it() -> None:
    rivals = [entry(100.0, 0.0, "a", "b"), entry(100.0, 0.0, "a", "c"), entry(400.0, 0.0)]
    weigh(rivals)
    total = by_cause(rivals)
    assert total["a"] == pytest.approx(1.0, abs=1e-6)
    assert total["b"] == pytest.approx(0.5, abs=1e-6)
    assert sum(item.probability for item in rivals) == pytest.approx(1.0)
