"""A stroke advanced in pieces is the same stroke, and looking at it does not change it."""

from __future__ import annotations

import numpy as np
import pytest

from plant.integrator.hybrid import Event
from plant.systems.length_stroke import LengthStroke
from tests.physics.bare import MS, NOMINAL
from tests.physics.strokes import length_stroke

END = 300 * MS
SWITCHES = [(18 * MS, 0, 1.0), (235 * MS, 0, 0.0)]
LOADS = [
    {},
    {"mounted": True, "mesh_force_n": 800.0, "sync_impulse_n_s": 14.0},
    {"damper": "compressible"},
]


def pieces(bounds: list[int], load: dict[str, object], samples: int = 0) -> LengthStroke:
    """The same N-B shift, advanced from bound to bound."""
    actuator = length_stroke(NOMINAL, **load)
    before = 0
    for bound in bounds:
        inside = [s for s in SWITCHES if before < s[0] <= bound]
        wanted = None
        if samples:
            wanted = np.linspace(before + 1, bound, samples).astype(np.int64)
        actuator.advance(bound, inside, wanted)
        before = bound
    return actuator


def reported(actuator: LengthStroke) -> list[Event]:
    """Its events without those of the oil, which empties asymptotically and fills at any touch."""
    return [event for event in actuator.events if not event.name.startswith("oil")]


@pytest.mark.parametrize("load", LOADS, ids=["free", "truck", "damper"])
@pytest.mark.parametrize("period", [10 * MS, 2_500_000, 333_333])
def test_pieces_give_the_same_events(load: dict[str, object], period: int) -> None:
    whole = pieces([END], load)
    parts = pieces([*range(period, END, period), END], load)
    assert [e.name for e in reported(parts)] == [e.name for e in reported(whole)]
    assert len(reported(whole)) > 3
    for a, b in zip(reported(parts), reported(whole), strict=True):
        assert a.time_s == pytest.approx(b.time_s, abs=1e-8)
        assert a.speed_m_s == pytest.approx(b.speed_m_s, rel=3e-6)
    assert parts.balance().closed


@pytest.mark.parametrize("load", LOADS, ids=["free", "truck", "damper"])
def test_a_sample_request_does_not_change_the_motion(load: dict[str, object]) -> None:
    bounds = [*range(10 * MS, END, 10 * MS), END]
    unseen, seen = pieces(bounds, load), pieces(bounds, load, samples=97)
    assert seen.row().tobytes() == unseen.row().tobytes()
    assert seen.events == unseen.events


def test_switches_and_instants_out_of_order_are_refused() -> None:
    actuator = LengthStroke(NOMINAL)
    actuator.advance(10 * MS)
    with pytest.raises(ValueError, match="back"):
        actuator.advance(9 * MS)
    for switches in (
        [(9 * MS, 0, 1.0)],
        [(21 * MS, 0, 1.0)],
        [(15 * MS, 0, 1.0), (12 * MS, 0, 0.0)],
    ):
        with pytest.raises(ValueError, match="out of order"):
            actuator.advance(20 * MS, switches)


@pytest.mark.parametrize("instant", [50 * MS, 50 * MS + 1])
def test_a_switch_at_the_end_of_a_piece_acts_from_there_on(instant: int) -> None:
    split = LengthStroke(NOMINAL)
    split.advance(instant, [(instant, 0, 1.0)])
    split.advance(END)
    whole = LengthStroke(NOMINAL)
    whole.advance(END, [(instant, 0, 1.0)])
    assert split.row() == pytest.approx(whole.row(), rel=1e-9, abs=1e-9)
