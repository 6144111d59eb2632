"""The figures of a replay: scenes of both sides on one time axis, with gaps between them."""

from __future__ import annotations

import numpy as np

from sil.log_replay.excerpts import Excerpt, Row
from sil.log_replay.figures import excerpts_figure
from sil.log_replay.replay import ReplayRequest, replay
from sil.report.figure import Series
from tests.support.golden_logs import golden

FOUND = replay(ReplayRequest(str(golden("full_shift")), settings={"controller.filter": False}))


def test_both_shifts_are_on_the_axis_once() -> None:
    scenes = FOUND.comparison.excerpts.excerpts
    (stack,) = excerpts_figure(scenes, FOUND.labels, FOUND.grid.origin_ns).stacks
    assert len(stack.zooms) == 2 and all(zoom.name.endswith("differs") for zoom in stack.zooms)
    position, coils, states = stack.panels
    recorded, replayed = position.series
    for line in (recorded, replayed):
        assert np.all(np.diff(line.x) > 0.0)
    assert not np.array_equal(recorded.y, replayed.y, equal_nan=True)
    assert np.nanmax(recorded.y) > 12.0
    assert len(coils.ticks) == 6 and {span.role for span in coils.spans} == {"N", "F"}
    assert {"push", "blow", "hold"} <= {span.label for span in states.spans}


def test_lines_have_a_gap_only_between_scenes_that_are_apart() -> None:
    rows = FOUND.comparison.excerpts.excerpts[0].rows

    def estimates(*parts: list[Row]) -> list[Series]:
        (stack,) = excerpts_figure([Excerpt(part) for part in parts], FOUND.labels, 0).stacks
        return list(stack.panels[0].series)

    for one, other in zip(estimates(rows[:9], rows[5:]), estimates(rows), strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.y, other.y)
    for line in estimates(rows[:5], rows[9:]):
        assert np.isnan(line.y).sum() == 1 and np.all(np.diff(line.x) > 0.0)
