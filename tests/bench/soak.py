"""A soak: hours in lockstep, minutes in real time, the memory of every process over time.

`python -m tests.bench.soak [--hours H] [--minutes M] [--out DIR]`. One shift every ten seconds,
through all gears: a day takes about 50 minutes and 8 GB of disk. Memory may grow only while a run is
judged, by what result.json holds of each shift, some 2 KiB.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

SHIFT_EVERY_S = 10.0
GEARS = ("backward", "neutral", "forward", "neutral")
SAMPLES = 600
MIB = 1 << 20


def measure() -> Iterator[str]:
    """Lines about a simulated day in lockstep and ten minutes in real time."""
    yield from soak(24.0, 10.0, Path("runs/soak"))


def soak(hours: float, minutes: float, out: Path) -> Iterator[str]:
    """Lines about both runs; pictures of their memory and the run's result stay in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    if hours > 0.0:
        yield from one("lockstep", 3600.0 * hours, [], out)
    if minutes > 0.0:
        options = ["--transport", "local", "--realtime"]
        yield from one("real_time", 60.0 * minutes, options, out)


def scenario_text(name: str, duration_s: float) -> str:
    """A scenario of that length, as a user would write it."""
    instants = np.arange(SHIFT_EVERY_S / 2, duration_s - 1.0, SHIFT_EVERY_S)
    requests = "\n".join(
        f'  {{ at_s = {at:g}, gear = "{GEARS[k % len(GEARS)]}" }},' for k, at in enumerate(instants)
    )
    return (
        f'name = "{name}"\nduration_s = {duration_s:g}\ntrace_period_s = 0.02\n'
        f"request = [\n{requests}\n]\n"
        "[plant]\nmounted = true\nmesh_force_n = 500.0\npull_force_n = 500.0\n"
        "[driveline]\nimpulse_backward_n_s = 18.0\nimpulse_forward_n_s = 18.0\n"
    )


def one(name: str, duration_s: float, options: list[str], out: Path) -> Iterator[str]:
    """Run it with `opc4 run` while its memory is looked at; lines about what was found."""
    file, folder = out / f"{name}.toml", out / name
    file.write_text(scenario_text(name, duration_s), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "sil.cli", "run", str(file), "--out", str(folder)]
    before_s = children_cpu_s()
    times, rows, written_s = watched(
        [*command, "--no-report", *options], folder / "bus.log", duration_s
    )
    cpu_s = children_cpu_s() - before_s
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    picture = out / f"{name}.png"
    draw(picture, times, rows, f"{name}: {duration_s / 3600:.3g} simulated hours")
    if not result["complete"]:
        yield f"{name}: not complete: {result['why']}; memory so far in {picture}"
        return
    speed, bus = result["speed"], result["bus"]
    yield (
        f"{name}: {duration_s / 3600:.3g} simulated h in {speed['wall_s'] / 60:.1f} wall min, "
        f"{(times[-1] - written_s) / 60:.1f} of them to judge it, "
        f"{cpu_s / 60:.1f} min of CPU, {len(result['metrics']['shifts'])} shifts, {bus['frames']} frames, "
        f"status {result['status']}"
    )
    yield f"  frames lost: {lost(result, duration_s)}"
    for who in sorted({who for row in rows for who in row}):
        sizes = np.array([row.get(who, np.nan) for row in rows])
        yield "  " + line(who, times, sizes, written_s)
    if "late_p50_s" in speed:
        late = ", ".join(f"{q} {1e3 * speed[f'late_{q}_s']:.3f} ms" for q in ("p50", "p99", "max"))
        yield f"  jitter: instants late by {late}; {speed['overruns']:.0f} overruns"
    yield f"  picture {picture}"
    for big in ("bus.log", "trace.csv"):
        (folder / big).unlink(missing_ok=True)


def lost(result: dict[str, Any], duration_s: float) -> str:
    """Frames that are missing: by their periods, by what the bus counted, by the counters."""
    missing = sum(
        max(0, int(duration_s / m["period_s"]) - m["frames"]) for m in result["bus"]["messages"]
    )
    counted = sum(
        result["bus"][k] for k in ("lost", "overwritten", "dropped_full", "dropped_bus_off")
    )
    gaps = sum(
        c["ok, some lost"] + c["wrong sequence"] for c in result["bus"]["end_to_end"].values()
    )
    return f"{missing} by their periods, {counted} by the bus, {gaps} gaps in the counters"


def watched(
    command: list[str], log: Path, duration_s: float
) -> tuple[np.ndarray, list[dict[str, float]], float]:
    """Run a command; when [wall s] it was looked at, resident MiB by process, when the log ended."""
    begun = time.monotonic()
    times: list[float] = []
    rows: list[dict[str, float]] = []
    logged, written_s = 0, 0.0
    step_s = max(0.5, min(10.0, duration_s / SAMPLES / 20.0))
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None:
        time.sleep(step_s)
        found = {}
        for pid, who in family(process.pid):
            size = resident_mib(pid)
            if size > 0.0:
                found[who] = size
        times.append(time.monotonic() - begun)
        rows.append(found)
        if log.exists() and log.stat().st_size > logged:
            logged, written_s = log.stat().st_size, times[-1]
    return np.array(times), rows, written_s


def children_cpu_s() -> float:
    """CPU time of the processes that have ended, and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def family(pid: int) -> Iterator[tuple[int, str]]:
    """A process and its children, by what they do."""
    yield pid, "coordinator"
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
        for child in map(int, children):
            words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            if b"node" in words:
                yield child, words[words.index(b"node") + 1].decode()
    except (OSError, ValueError):  # it ended meanwhile
        return


def resident_mib(pid: int) -> float:
    """Resident memory of a process, MiB; 0 when it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * 4096 / MIB


def line(who: str, times: np.ndarray, sizes: np.ndarray, written_s: float) -> str:
    """How memory went: after a tenth of the run, at its end, growth as a fitted line; and judged."""
    seen = np.isfinite(sizes)
    t, y = times[seen], sizes[seen]
    # the look that still saw the log grow may already have seen the judging
    running = (t > 0.1 * written_s) & (t < written_s)
    if np.count_nonzero(running) < 10:
        return f"{who}: too few samples"
    slope = float(np.polyfit(t[running], y[running], 1)[0]) * 3600.0
    text = (
        f"{who}: {y[running][0]:.1f} MiB after a tenth of the run, {y[running][-1]:.1f} at its end, "
        f"{slope:+.2f} MiB per wall hour"
    )
    after = y[t > written_s]
    return text + (f"; at most {after.max():.1f} while it was judged" if len(after) else "")


def draw(path: Path, times: np.ndarray, rows: list[dict[str, float]], title: str) -> None:
    """Draw resident memory over wall time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for who in sorted({who for row in rows for who in row}):
        axes.plot(times / 60.0, [row.get(who, np.nan) for row in rows], label=who)
    axes.set(xlabel="wall time, min", ylabel="resident memory, MiB", title=title)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=120)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated, in lockstep [24]")
    parser.add_argument("--minutes", type=float, default=10.0, help="wall, in real time [10]")
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), metavar="DIR")
    arguments = parser.parse_args()
    for text in soak(arguments.hours, arguments.minutes, arguments.out):
        print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
