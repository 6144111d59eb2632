"""Changes confirmed by fits to shifts: named by what explains them, refused if nothing does."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sil.shift_diagnosis.change import Change, renamed
from sil.shift_diagnosis.confirm import Confirming
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.track import Track
from tests.unit.sil.shift_diagnosis.fits import only

CAUSES = [only(name) for name in ("valve_open_delay", "static_friction", "sensor_gain")]
LATE, STATIC, GAIN = (cause.effect.id for cause in CAUSES)
PRECISION = 4.0


def confirming(true: dict[str, float]) -> Confirming:
    """Return what confirms changes of 24 shifts whose chi squared is that of other sizes."""

    def linear(
        shifts: Sequence[int], causes: Sequence[Cause], active: dict[Cause, float]
    ) -> SimpleNamespace:
        sizes = {cause.effect.id: size for cause, size in active.items()}
        away = [true.get(c.effect.id, 0.0) - sizes.get(c.effect.id, 0.0) for c in CAUSES]
        own = [away[CAUSES.index(cause)] for cause in causes]
        n = len(shifts)
        return SimpleNamespace(
            units=0,
            misfit=np.full(n, 10.0 + PRECISION * float(np.square(away).sum())),
            information=np.broadcast_to(PRECISION * np.eye(len(causes)), (n, len(causes), len(causes))),
            score=np.tile(PRECISION * np.array(own), (n, 1)),
        )  # fmt: skip

    names = tuple(cause.effect.id for cause in CAUSES)
    track = Track.of(names)
    sizes = np.zeros((200, 3))
    sizes[176:, 1] = 2.0  # what the linear model says
    track.take(np.broadcast_to(np.eye(3), (200, 3, 3)), sizes, np.arange(200.0))
    track.changes.clear()
    return Confirming(track, 176, list(range(24)), linear, CAUSES, {})


def scatter(between2: float) -> Any:
    return SimpleNamespace(within2=np.ones(3), between2=np.full(3, between2))


def change(name: str) -> Change:
    return Change(
        name=name, kind="step", shift=180, low=180, high=180, time_s=0.0, found=200, sigma=9.0, alike=[]
    )  # fmt: skip


def test_a_change_gets_the_name_of_what_explains_its_shifts() -> None:
    confirm = confirming({LATE: 1.5})
    confirm.track.scatter = scatter(between2=0.0)
    found = confirm(change(STATIC))
    assert found is not None
    assert (found.name, found.alike) == (LATE, [])
    assert found.shift == 180
    # from the mean of 180 shifts of information 1 to a fit of 20 of 4; no scatter between trips
    assert found.sigma == pytest.approx(1.5 / np.hypot(180**-0.5, 80**-0.5), rel=0.02)


def test_a_name_that_scatters_as_much_from_trip_to_trip_is_not_significant() -> None:
    confirm = confirming({LATE: 1.5})
    confirm.track.scatter = scatter(between2=1.0)
    found = confirm(change(STATIC))
    assert found is not None and found.name == LATE
    assert found.sigma < 1.5


def test_what_leaves_far_more_than_the_best_is_not_alike() -> None:
    costs = {"a": 1000.0, "b": 2900.0, "c": 3100.0, "d": 1e6}
    assert renamed(change("d"), costs).alike == ["b"]
    assert renamed(change("d"), {"a": 70.0, "b": 78.0, "c": 80.0, "d": 110.0}).alike == ["b"]


@pytest.mark.parametrize("size", [0.0, 0.2])
def test_a_change_that_its_shifts_do_not_show_is_refused(size: float) -> None:
    assert confirming({STATIC: size})(change(STATIC)) is None


def test_without_shifts_after_it_a_change_waits() -> None:
    early = confirming({STATIC: 2.0})
    later = Confirming(early.track, 200, [], early.linear, CAUSES, {})
    assert later(change(STATIC)) is None
