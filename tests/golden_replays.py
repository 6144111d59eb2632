"""Golden replays: the shipped scenarios' bus, kept small, against the firmware as it is now.

python -m tests.golden_replays FOLDER [NAME...]            say what the firmware does differently
python -m tests.golden_replays FOLDER [NAME...] --update   say it, and record what changed anew
"""

from __future__ import annotations

import argparse
import gzip
import sys
from pathlib import Path

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.log_replay.recorded_frames import INPUTS, OUTPUTS, OWN_IDS
from sil.log_replay.replay import ReplayRequest, ReplayResult, replay
from sil.log_replay.report import summary_lines
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory

SUFFIX = ".log.gz"


def golden_path(folder: Path, name: str) -> Path:
    """Return where the golden log of a scenario lies."""
    return folder / f"{name}{SUFFIX}"


def check(folder: Path, name: str) -> ReplayResult:
    """Replay a golden log through the firmware with the scenario's settings. Raises InputError."""
    return replay(ReplayRequest(str(golden_path(folder, name)), run=name))


def record(name: str) -> bytes:
    """Run a shipped scenario and return what the control unit heard and said, as a packed log.

    Equal runs give equal lines; how they are packed depends on the version of zlib. Checked by: tests/scenarios/test_golden.py
    """
    lines = []
    for entry in run_in_memory(load_scenario.load(name)).record.frames:
        if OWN_IDS.get(entry.frame.can_id) in (*INPUTS, *OUTPUTS):
            lines.append(_line(entry.arrival_ns, entry.frame))
    return gzip.compress("".join(lines).encode(), compresslevel=9, mtime=0)


def _line(arrival_ns: int, frame: Frame) -> str:
    seconds, rest_ns = divmod(arrival_ns, 1_000_000_000)
    fraction = f"{rest_ns // 1000:06d}" if rest_ns % 1000 == 0 else f"{rest_ns:09d}"
    return f"({seconds:010d}.{fraction}) opc4 {frame.can_id:08X}#{frame.data.hex().upper()}\n"


def _changed(old: bytes, new: bytes) -> str:
    """Say how two packed logs differ."""
    before, after = (set(gzip.decompress(log).splitlines()) for log in (old, new))
    return (
        f"recorded anew: {len(after)} frames, {len(after - before)} of them others than in the "
        f"{len(before)} before"
    )


def update(folder: Path, name: str) -> list[str]:
    """Record a scenario anew and return what changed; nothing when nothing did."""
    path = golden_path(folder, name)
    new = record(name)
    if not path.exists():
        path.write_bytes(new)
        return [f"{name}: new, {len(gzip.decompress(new).splitlines())} frames, {len(new)} bytes"]
    old = path.read_bytes()
    if gzip.decompress(old) == gzip.decompress(new):
        return []
    lines = [f"{name}: {_changed(old, new)}"]
    try:
        outcome = check(folder, name)
        output = summary_lines(outcome)
        lines += ["  the firmware on the old inputs:", *(f"    {line}" for line in output)]
    except InputError as error:
        lines.append(f"  the old one cannot be replayed: {error}")
    path.write_bytes(new)
    return lines


def main(argv: list[str]) -> int:
    """Check or update; return 1 when a check found a difference."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden_replays", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--update", action="store_true")
    arguments = parser.parse_args(argv)
    folder: Path = arguments.folder
    shipped = load_scenario.shipped()
    for name in arguments.names:
        if name not in shipped:
            print(f"{name}: no shipped scenario; there are {', '.join(shipped)}", file=sys.stderr)
            return 2
    if not folder.is_dir():
        print(f"{folder}: no folder; expected that of the golden replays", file=sys.stderr)
        return 2
    names = arguments.names or list(shipped)
    try:
        return _update_all(folder, names) if arguments.update else _check_all(folder, names)
    except (InputError, RunError) as error:
        print(error, file=sys.stderr)
        return 2


def _check_all(folder: Path, names: list[str]) -> int:
    differing = 0
    for name in names:
        outcome = check(folder, name)
        differing += outcome.differs
        print("\n".join(summary_lines(outcome)[: None if outcome.differs else 1]))
    print(f"{differing} of {len(names)} differ")
    return 1 if differing else 0


def _update_all(folder: Path, names: list[str]) -> int:
    changed = 0
    for name in names:
        lines = update(folder, name)
        changed += bool(lines)
        if lines:
            print("\n".join(lines), flush=True)
    known = load_scenario.shipped()
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        if path.name.removesuffix(SUFFIX) not in known:
            path.unlink()
            changed += 1
            print(f"{path.name}: removed, its scenario is gone")
    print(f"{changed} changed, {len(names) - min(changed, len(names))} as they were")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
