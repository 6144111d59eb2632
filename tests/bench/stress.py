"""The bus under stress: what becomes of two shifts when others disturb, one file of tests/support/disturbed a line."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from can_dbc.messages import Fault, Gear
from sil.simulation.load_scenario import load
from sil.simulation.runner import run
from tests.support.disturbed_bus import NAMES, SCENARIOS, safety_of

HEAD = (
    f"{'scenario':18}{'load':>6}{'frames':>8}{'errors':>7}{'lost':>6}{'command':>10}{'refused':>9}"
    f"{'taken':>7}  {'asked/true/reported':27}{'impact':>7}{'orphan':>8}{'false':>7}  reported"
)


def measure() -> Iterator[str]:
    """Lines of the table, its legend, and the run with drifting clocks in real time."""
    yield HEAD
    for name in NAMES:
        yield line(load(str(SCENARIOS / f"{name}.toml")))
    yield "command: longest time from release to arrival of a valve command, ms; lost: overwritten"
    yield "before they were sent, dropped or sent into a bus-off; reported -: at the end no status is valid;"
    yield "refused: by the end-to-end check, of an intruder's frames"
    yield "or of what their counters did to ours; taken: an intruder's frame taken for a good one;"
    yield "orphan: ms a coil stayed on without a living controller; false: ms a gear was reported"
    yield "that the stay was not in; impact: the worst, m/s"
    loaded = load(str(SCENARIOS / "drift.toml"))
    with tempfile.TemporaryDirectory() as folder:
        result = run(loaded, Path(folder), transport="local", speed=1.0).result
    late = ", ".join(
        f"{q} {1e3 * result.speed[f'late_{q}_s']:.2f} ms" for q in ("p50", "p99", "max")
    )
    yield (
        f"drift, in real time, two processes: {result.status}, instants late by {late}, "
        f"{result.speed['overruns']:.0f} overruns, hash as in simulated time: "
        f"{'yes' if result.trace_sha256 == quick(loaded) else 'no'}"
    )


def quick(loaded: Any) -> str | None:
    """The hash of the same scenario in one process, as fast as it goes."""
    with tempfile.TemporaryDirectory() as folder:
        return run(loaded, Path(folder)).result.trace_sha256


def line(loaded: Any) -> str:
    """What happened in one scenario."""
    with tempfile.TemporaryDirectory() as folder:
        finished = run(loaded, Path(folder))
    bus, safety = finished.result.bus, safety_of(finished, loaded)
    checked = bus["end_to_end"].values()
    refused = sum(c["error"] + c["repeated"] + c["wrong sequence"] + c["sync"] for c in checked)
    taken = sum(c["intruder's taken"] for c in checked)
    lost = sum(bus[k] for k in ("lost", "overwritten", "dropped_full", "dropped_bus_off"))
    command = next(m for m in bus["messages"] if m["name"] == "ValveCommand")["longest_response_s"]
    asked = loaded.scenario.request[-1].gear
    truly, reported = (
        "-" if math.isnan(safety[k]) else Gear(int(safety[k])).name.lower()
        for k in ("end_gear", "reported_gear")
    )
    bits = Fault(int(safety["fault_bits"]))
    names = " ".join(f.name or "" for f in Fault if f and f in bits).lower() or "-"
    return (
        f"{loaded.scenario.name:18}{bus['load']:6.0%}{bus['frames']:8d}{bus['error_frames']:7d}"
        f"{lost:6d}{1e3 * command:10.2f}{refused:9d}{taken:7d}  {f'{asked}/{truly}/{reported}':27}"
        f"{safety['worst_impact_m_s']:7.2f}{1e3 * safety['orphan_energised_s']:8.0f}"
        f"{1e3 * safety['false_gear_s']:7.0f}  {names}"
    )
