"""Held-out strokes: whole ones, every kind on both sides."""

from __future__ import annotations

from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st

from sil.diagnosis.split import MOST_TRAINING, split, stratum

stroke = st.builds(
    lambda kind, load, charged: SimpleNamespace(
        conditions=SimpleNamespace(kind=kind, load=load, charged_before=charged)
    ),
    st.sampled_from(["fixed", "N-B", "B-N"]),
    st.sampled_from(["none", "damper"]),
    st.sampled_from([(), ("N",)]),
)


@given(st.lists(stroke, min_size=3, max_size=40))
def test_every_stroke_is_on_one_side_and_strata_train_first(strokes) -> None:
    training, held_out = split(strokes)
    assert sorted(training + held_out) == list(range(len(strokes)))
    assert held_out and len(training) <= MOST_TRAINING
    kinds = {stratum(item) for item in strokes}
    if len(kinds) <= len(training):
        assert {stratum(strokes[k]) for k in training} == kinds


def test_two_strokes_all_train() -> None:
    both = [SimpleNamespace(), SimpleNamespace()]
    assert split(both) == ((0, 1), ())
