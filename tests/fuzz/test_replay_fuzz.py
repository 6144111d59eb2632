"""Logs cut, torn, thinned, shuffled and shifted in time: replayed or refused in a line, all counted."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.log_replay.replay import ReplayRequest, replay
from sil.log_replay.report import as_dict, summary_lines, text
from tests.support.golden_logs import GOLDEN

NAMES = ("lab_n_b", "full_shift", "bus_off", "firmware_2500us", "late_valve_commands")
LONGEST_S = 60.0
"""A log that keeps the processor busy for longer counts as a hang."""
IDS = ("08FF1003", "08FF1103", "10FF3003", "0CFF0005", "0CFF2091", "0CFF2192", "0CF00203")


def lines(name: str) -> list[str]:
    import gzip

    return gzip.decompress((GOLDEN / f"{name}.log.gz").read_bytes()).decode().splitlines()


def mutated(log: list[str], rng: random.Random) -> list[str]:
    """One of the things that happen to logs."""
    a = rng.randrange(len(log))
    b = a + rng.randrange(1, 400)
    kind = rng.randrange(9)
    if kind == 0:
        return log[:a] + log[b:]
    if kind == 1:
        return log[: max(a, 1)]
    if kind == 2:
        return log[a:]
    if kind == 3:
        for _ in range(rng.randrange(1, 60)):
            place = rng.randrange(len(log))
            at = rng.randrange(len(log[place]))
            log[place] = (
                log[place][:at] + rng.choice("0123456789ABCDEF#() .") + log[place][at + 1 :]
            )
        return log
    if kind == 4:
        return rng.sample(log, len(log))
    if kind == 5:
        return [line for line in log if rng.random() > 0.3]
    if kind == 6:
        rare = rng.choice(IDS)
        return [line for line in log if rare not in line or rng.random() < 0.1]
    if kind == 7:
        return log[a:b] * 3
    later_s = rng.choice((5, 5000, 10**9, 4 * 10**9))
    return log[:a] + [f"({int(x[1:11]) + later_s:010d}{x[11:]}" for x in log[a:]]


def broken(seed: int, folder: Path) -> Path:
    rng = random.Random(seed)
    path = folder / "broken.log"
    path.write_text("\n".join(mutated(lines(rng.choice(NAMES)), rng)) + "\n")
    return path


def require_replayed_or_refused(path: Path) -> bool:
    begun = time.process_time()
    try:
        found = replay(ReplayRequest(str(path)))
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return False
    assert found.account.total == found.frames
    assert len(text(found)) > 100 and as_dict(found) and summary_lines(found)
    assert time.process_time() - begun < LONGEST_S
    return True


@pytest.mark.parametrize(
    ("seeds", "fewest", "most"),
    [(range(60), 15, 55), pytest.param(range(60, 500), 150, 400, marks=pytest.mark.slow)],
)
def test_broken_logs_are_replayed_or_refused(
    seeds: range, fewest: int, most: int, tmp_path: Path
) -> None:
    replayed = [require_replayed_or_refused(broken(seed, tmp_path)) for seed in seeds]
    assert fewest < sum(replayed) < most
