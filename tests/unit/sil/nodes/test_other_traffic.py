"""Other nodes' traffic: the share of the bus it takes, and that it repeats."""

from __future__ import annotations

import pytest

from can_dbc.frame import split_id
from sil.coupling.bus import BusModel
from sil.nodes.other_traffic import TrafficNode

MS = 1_000_000


def carried(load: float, seed: int) -> tuple[BusModel, list[tuple[int, int, bytes]]]:
    node, bus = TrafficNode(load, 6, 500_000, seed), BusModel(500_000)
    at, log = node.start(), []
    while at < 2_000 * MS:
        log += [(d.arrival_ns, d.frame.can_id, d.frame.data) for d in bus.advance(at)]
        frames, at = node.advance(at, [])
        for release, frame in frames:
            bus.queue(release, frame, node.name)
    return bus, log


@pytest.mark.parametrize("load", [0.05, 0.4, 0.9])
def test_load_is_what_was_asked_for(load: float) -> None:
    bus, log = carried(load, 1)
    assert bus.load == pytest.approx(load, rel=0.03)
    assert {split_id(can_id).priority for _, can_id, _ in log} == {6}


def test_seeded() -> None:
    assert carried(0.3, 1)[1] == carried(0.3, 1)[1]
    assert carried(0.3, 1)[1] != carried(0.3, 2)[1]


def test_nothing_between_two_windows() -> None:
    node = TrafficNode(0.5, 3, 500_000, 1)
    assert node.advance(0, [])[1] == 10 * MS
    assert node.advance(4 * MS, []) == ([], 10 * MS)
