"""Held-out strokes: whole ones, every kind on both sides."""

from __future__ import annotations

from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st

from sil.inference.campaign.split import split, stratum

stroke = st.builds(
    lambda kind, load, charged, rest: SimpleNamespace(
        conditions=SimpleNamespace(kind=kind, load=load, charged_before=charged, rest_s=rest),
        entry=SimpleNamespace(session=""),
    ),
    st.sampled_from(["fixed", "N-B", "B-N"]),
    st.sampled_from(["none", "damper"]),
    st.sampled_from([(), ("N",)]),
    st.sampled_from([2.0, 30.0, 600.0]),
)


@given(st.lists(stroke, min_size=3, max_size=40))
def test_every_stroke_is_on_one_side_and_strata_train_first(strokes) -> None:
    training, held_out = split(strokes)
    assert sorted(training + held_out) == list(range(len(strokes)))
    assert held_out and len(training) <= 14
    kinds = {stratum(item) for item in strokes}
    if len(kinds) <= len(training):
        assert {stratum(strokes[k]) for k in training} == kinds


@given(st.lists(stroke, min_size=12, max_size=40))
def test_every_rest_trains_where_strokes_are_alike(strokes) -> None:
    for item in strokes:
        item.conditions.kind, item.conditions.load = "fixed", "none"
    training, _held_out = split(strokes)
    assert {strokes[k].conditions.rest_s for k in training} == {
        s.conditions.rest_s for s in strokes
    }


def test_two_strokes_all_train() -> None:
    both = [SimpleNamespace(), SimpleNamespace()]
    assert split(both) == ((0, 1), ())
