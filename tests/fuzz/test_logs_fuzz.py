"""Damaged logs of every format: read, replayed or refused; never a crash, a hang or a frame invented."""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.j1939.summary import summarize
from sil.log_replay.replay import ReplayRequest, replay
from sil.log_replay.report import as_dict, summary_lines, text
from sil.logs import LogFrame, open_log, open_writer
from sil.logs.frame import DLC_LENGTHS, frame_problem
from tests.support.golden_logs import GOLDEN

FIXTURES = Path(__file__).resolve().parent.parent / "data" / "logs"
LONGEST_S = 60.0
"""A log that keeps the processor busy for longer counts as a hang."""
SEED = 20_240_607

TEXT_SEEDS = sorted(path.name for path in FIXTURES.iterdir() if path.suffix != ".md")
WRITTEN = ("log", "asc", "trc", "csv", "blf", "log.gz", "blf.gz")


def made_frames(count: int) -> list[LogFrame]:
    """Frames of every kind, one after the other in time."""
    rng = random.Random(SEED)
    found = []
    time_ns = 1_700_000_000_000_000_000
    for index in range(count):
        time_ns += rng.randrange(100, 3_000) * 1000
        extended = rng.random() < 0.7
        can_id = rng.randrange(1 << 29 if extended else 1 << 11)
        kind = index % 8
        base = LogFrame(time_ns, can_id, b"", extended, channel="1", direction="Rx")
        if kind == 6:
            found.append(base._replace(remote=True, raw_dlc=rng.randrange(9)))
        elif kind == 7:
            data = rng.randbytes(rng.choice(DLC_LENGTHS))
            found.append(base._replace(fd=True, brs=rng.random() < 0.5, data=data))
        else:
            found.append(base._replace(data=rng.randbytes(rng.randrange(9))))
    return found


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Whole logs of every format, by a name with their suffix."""
    folder = tmp_path_factory.mktemp("seeds")
    found = {name: (FIXTURES / name).read_bytes() for name in TEXT_SEEDS}
    frames = made_frames(40)
    for suffix in WRITTEN:
        path = folder / f"made.{suffix}"
        with open_writer(path) as writer:
            for frame in frames:
                writer.write(frame)
        found[path.name] = path.read_bytes()
    return found


def mutated(rng: random.Random, blob: bytes) -> bytes:
    """The bytes after one to four accidents."""
    damaged = bytearray(blob)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not damaged:
            break
        index = rng.randrange(len(damaged))
        length = min(rng.choice((1, 2, 4, 8, 64)), len(damaged) - index)
        accident = rng.randrange(9)
        if accident == 0:
            damaged[index] ^= 1 << rng.randrange(8)
        elif accident == 1:
            damaged[index] = rng.randrange(256)
        elif accident == 2:
            del damaged[index : index + length]
        elif accident == 3:
            damaged[index:index] = rng.randbytes(length)
        elif accident == 4:
            del damaged[index:]
        elif accident == 5:
            damaged[index:index] = damaged[index : index + length]
        elif accident == 6:
            damaged[index : index + length] = bytes([rng.choice((0, 0xFF, 0x30, 0x0A))]) * length
        elif accident == 7:
            other = rng.randrange(len(damaged))
            damaged[index : index + length] = damaged[other : other + length]
        else:
            damaged[index : index + 8] = rng.choice((2**63, 2**32, 64, len(blob), 1)).to_bytes(
                8, "little"
            )[: max(length, 1)]
    return bytes(damaged)


def read(path: Path, *, strict: bool = False) -> list[LogFrame]:
    """All frames of a log, none for a refused one; anything else than InputError goes up."""
    begun = time.process_time()
    frames: list[LogFrame] = []
    try:
        frames.extend(open_log(path, strict=strict))
    except InputError as error:
        assert str(error).isprintable()
        assert str(path) in str(error)
    assert time.process_time() - begun < LONGEST_S
    return frames


def most_frames(blob: bytes, name: str) -> int:
    """More frames than this cannot be in a file: one for each line, or for each record."""
    if name.endswith((".blf", ".gz")):
        return 10_000
    return blob.count(b"\n") + 1


@pytest.mark.parametrize(
    ("cases", "seed"), [(900, SEED), pytest.param(20_000, SEED + 1, marks=pytest.mark.slow)]
)
def test_mutants_are_read_or_refused(
    cases: int, seed: int, seeds: dict[str, bytes], tmp_path: Path
) -> None:
    ends: Counter[str] = Counter()
    for name, blob in seeds.items():
        rng = random.Random(f"{seed} {name}")
        path = tmp_path / name
        for _ in range(-(-cases // len(seeds))):
            damaged = mutated(rng, blob)
            path.write_bytes(damaged)
            frames = read(path, strict=rng.random() < 0.2)
            assert len(frames) <= most_frames(damaged, name), name
            for frame in frames:
                assert frame_problem(frame) is None, (name, frame)
            ends["read" if frames else "nothing"] += 1
    assert ends["read"] > ends["nothing"] > 0


def identity(frame: LogFrame) -> tuple[object, ...]:
    return frame.time_ns, frame.can_id, frame.data, frame.extended, frame.remote, frame.error


@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_cut_logs_invent_nothing(count: int, seeds: dict[str, bytes], tmp_path: Path) -> None:
    """A log that is cut off gives nothing but frames of the whole log, in their order."""
    for name, blob in seeds.items():
        if name.startswith("torn"):
            continue
        path = tmp_path / name
        path.write_bytes(blob)
        whole = [identity(frame) for frame in read(path)]
        rng = random.Random(f"cut {name}")
        for length in (rng.randrange(len(blob)) for _ in range(count)):
            path.write_bytes(blob[:length])
            left = iter(whole)
            for frame in read(path):
                assert identity(frame) in left, (name, length, frame)


def test_garbage_lines_add_nothing(seeds: dict[str, bytes], tmp_path: Path) -> None:
    for name in TEXT_SEEDS:
        if name.startswith("torn") or name == "signals.csv":
            continue
        path = tmp_path / name
        path.write_bytes(seeds[name])
        sound = open_log(path)
        whole = list(sound)
        rng = random.Random(f"garbage {name}")
        lines = seeds[name].splitlines(keepends=True)
        for _ in range(5):
            garbage = bytes(rng.choice(b"?!~{}|^$") for _ in range(rng.randrange(1, 60))) + b"\n"
            torn = [*lines]
            torn.insert(rng.randrange(1, len(torn) + 1), garbage)
            path.write_bytes(b"".join(torn))
            reader = open_log(path)
            assert list(reader) == whole, name
            assert reader.report.skipped == sound.report.skipped + 1, name
            with pytest.raises(InputError, match=r"line \d+"):
                list(open_log(path, strict=True))


def test_damaged_packed_containers_invent_nothing(seeds: dict[str, bytes], tmp_path: Path) -> None:
    """BLF containers and MF4 blocks carry a checksum: a damaged one is left out whole."""
    for name, first in (("made.blf", 300), ("made.log.gz", 40)):
        blob = seeds[name]
        path = tmp_path / name
        path.write_bytes(blob)
        whole = {identity(frame) for frame in read(path)}
        rng = random.Random(f"packed {name}")
        for _ in range(60):
            damaged = bytearray(blob)
            damaged[rng.randrange(first, len(blob) - 8)] ^= 1 << rng.randrange(8)
            path.write_bytes(damaged)
            if name.endswith(".blf"):
                assert {identity(frame) for frame in read(path)} <= whole
            else:
                reader = open_log(path)
                try:
                    frames = list(reader)
                except InputError:
                    continue
                report = reader.report
                assert report.skipped or report.truncated or len(frames) == len(whole)


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "trc", "mf4", "csv", "log.gz"])
def test_noise_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"noise.{suffix}"
    rng = random.Random(suffix)
    for length in (1, 100, 10_000, 300_000):
        path.write_bytes(rng.randbytes(length))
        with pytest.raises(InputError, match="expected"):
            list(open_log(path))


def test_summaries_of_mutants(seeds: dict[str, bytes], tmp_path: Path) -> None:
    rng = random.Random("summary")
    for name, blob in seeds.items():
        path = tmp_path / name
        for _ in range(4):
            path.write_bytes(mutated(rng, blob))
            with contextlib.suppress(InputError):
                summarize(open_log(path))


NAMES = ("lab_n_b", "full_shift", "bus_off", "firmware_2500us", "late_valve_commands")
"""A log that keeps the processor busy for longer counts as a hang."""
IDS = ("08FF1003", "08FF1103", "10FF3003", "0CFF0005", "0CFF2091", "0CFF2192", "0CF00203")


def lines(name: str) -> list[str]:
    import gzip

    return gzip.decompress((GOLDEN / f"{name}.log.gz").read_bytes()).decode().splitlines()


def mutated_lines(log: list[str], rng: random.Random) -> list[str]:
    """The lines after one of the things that happen to logs."""
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
    path.write_text("\n".join(mutated_lines(lines(rng.choice(NAMES)), rng)) + "\n")
    return path


def require_replayed_or_refused(path: Path) -> bool:
    begun = time.process_time()
    try:
        found = replay(ReplayRequest(str(path)))
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return False
    assert found.account.total() == found.frames
    assert len(text(found)) > 100 and as_dict(found) and summary_lines(found)
    assert time.process_time() - begun < LONGEST_S
    return True


@pytest.mark.parametrize(
    ("seeds", "fewest", "most"),
    [(range(20), 5, 18), pytest.param(range(20, 220), 65, 185, marks=pytest.mark.slow)],
)
def test_broken_logs_are_replayed_or_refused(
    seeds: range, fewest: int, most: int, tmp_path: Path
) -> None:
    replayed = [require_replayed_or_refused(broken(seed, tmp_path)) for seed in seeds]
    assert fewest < sum(replayed) < most
