"""ExcerptRecorder around edges, few and short, and their waveforms in letters."""

from __future__ import annotations

from sil.log_replay.excerpts import Excerpt, ExcerptRecorder, Row, waveforms

TICK = 10_000_000


def row(k: int, a: bool, b: bool, states: tuple[str, str] = ("IDLE", "IDLE")) -> Row:
    return Row(k * TICK, ((a, False, False), (b, False, False)), states, (0.0, 0.0))


def test_a_scene_has_what_came_before_and_after() -> None:
    scenes = ExcerptRecorder()
    for k in range(200):
        scenes.take(row(k, k >= 100, k >= 100), changed=k == 100, differs=False)
    (scene,) = scenes.excerpts
    assert (scene.rows[0].time_ns, scene.rows[-1].time_ns) == (92 * TICK, 116 * TICK)
    assert not scene.differs


def test_only_so_many_and_so_long_scenes_are_kept() -> None:
    scenes = ExcerptRecorder()
    for k in range(4_000):  # a difference and an edge in turn, every half second
        scenes.take(row(k, False, k % 100 < 5), changed=k % 100 == 50, differs=k % 100 < 5)
    assert sum(s.differs for s in scenes.excerpts) == 6
    assert sum(not s.differs for s in scenes.excerpts) == 3
    always = ExcerptRecorder()
    for k in range(50_000):
        always.take(row(k, False, True), changed=False, differs=True)
    assert len(always.excerpts) == 6
    assert all(len(s.rows) <= 1000 for s in always.excerpts)
    assert always.excerpts[0].rows[-1].time_ns <= 1_500_000_000 + TICK


def test_waveforms_show_both_sides_and_mark_what_differs() -> None:
    on = [False, True, True, True, False, False]
    off = [False, True, False, False, False, False]
    states = (
        [("IDLE", "IDLE")] + [("PUSH", "PUSH")] + [("PUSH", "HOLD")] * 2 + [("IDLE", "IDLE")] * 2
    )
    rows = [row(k, *x) for k, x in enumerate(zip(on, off, states, strict=True))]
    assert waveforms(Excerpt(rows, True), ("recorded", "replayed"), 5 * TICK) == [
        "from 0.050000 s, 10 ms per column",
        "valve B   recorded _###__",
        "          replayed _#____",
        "                     ^^",
        "state     recorded ||PU|I",
        "          replayed |||H|I",
        "                     ^^",
        "",
    ]
