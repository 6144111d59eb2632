"""Fit what the samples of the position tell of a push: `controller/strategies/motion.py`, and the teeth.

python -m tests.bench._learned_motion FIRST LAST SHIFTS

The onset from plain pushes of the shipped scenario, over the pressure of the supply and the phase of the
sensor. The release from trucks FIRST to LAST of the shipped population, SHIFTS of each, by the open loop
and by strategy learned; the age of the samples is fitted with it, one for each truck. The meshing force
(`controller.learning.heavier_by`) from light pushes of the same trucks against teeth from 12 % lighter to
15 % heavier. Prints the constants and their errors.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from controller.learning import STOPPED_S, heavier_by
from controller.position import Estimate, Sample
from controller.programmes import library
from controller.strategies import Duties, ShiftContext, Strategy
from controller.strategies.learned import Learned
from controller.strategies.motion import (
    FAR_M,
    HIGHEST_M,
    LOWEST_M,
    MEAN_PA,
    START_S,
    Motion,
)
from controller.strategies.open_loop import OpenLoop
from sil.simulation.in_memory import Run, run_in_memory
from sil.studies.fleet import OWN, FleetTable, Truck
from sil.studies.kinds.learned import TABLES_MESH_N, nominal
from sil.studies.load_study import load_study
from sil.studies.study import texts_of

PHASES_S = np.arange(20) * 0.0005
SUPPLIES_PA = 8e5, 8.25e5, 8.5e5, 8.75e5, 9e5
SEED, PERIOD_S, STROKE_M = 7, 0.01, 0.01285
LATE_S = 0.0004
RESTED_S = 0.3
"""Neutral was filled so long before: its air is gone."""
LIGHT_N_S = 14.0, 28.0


def sampled(
    settings: dict[str, Any], kind: type[Strategy], memory: bytes = b""
) -> tuple[Run, list[tuple[float, float]], float]:
    """Run a shift. Return it, time in s and position in m of each step of its push, and when that began."""
    found: list[tuple[float, float]] = []
    began_s = [0.0]
    plain = kind.command

    def noting(self: Strategy, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        found.append((1e-9 * (now_ns - shift.start_ns), estimate.raw_m))
        began_s[0] = 1e-9 * shift.start_ns
        return plain(self, now_ns, estimate, shift)

    setattr(kind, "command", noting)  # noqa: B010
    try:
        run = run_in_memory(load_study("learned").loaded(texts_of(settings)), memory)
    finally:
        setattr(kind, "command", plain)  # noqa: B010
    return run, found, began_s[0]


def onset() -> None:
    """Print the fit of the onset."""
    rows, times_ms = [], []
    for k, phase_s in enumerate(PHASES_S):
        for supply_pa in SUPPLIES_PA:
            settings = {
                "plant.mounted": True,
                "plant.supply_pressure_pa": supply_pa,
                "sensor.phase_s": float(phase_s),
                "driveline.residual_rad_s": 40.0,
                "request": [{"at_s": 0.1, "gear": "backward"}],
                "duration_s": 0.25,
            }
            _, ((_, rest_m), *found), _ = sampled(settings, OpenLoop)
            ways = [(time_s, abs(at_m - rest_m)) for time_s, at_m in found]
            time_s, way_m = next(each for each in ways if LOWEST_M <= each[1] <= HIGHEST_M)
            root, above = np.sqrt(1e3 * way_m), 1e-5 * (supply_pa - MEAN_PA)
            unknown = np.arange(len(PHASES_S)) == k
            rows.append([root, root**2, root**3, above, above * root, *unknown])
            times_ms.append(1e3 * time_s)
    fitted, errors = fit(np.array(rows, float), np.array(times_ms))
    print(f"onset, ms: {np.round(fitted[:5], 3)}; {errors}")


def fit(terms: Any, measured: Any) -> tuple[Any, str]:
    """Return the coefficients of terms [rows, terms] by least squares, and a text with the errors."""
    fitted = np.linalg.lstsq(terms, measured, rcond=None)[0]
    errors = measured - terms @ fitted
    sizes = f"sd {errors.std():.4f}, 95 % {np.quantile(abs(errors), 0.95):.4f}, at most {abs(errors).max():.4f}"
    return fitted, f"{len(errors)} rows, {sizes}"


class Push(NamedTuple):
    """What was measured of a push: motion, and by the plant's events when it was released, s since it began."""

    motion: Motion
    released_s: float
    settings: Mapping[str, Any]
    truck: int
    kind: str


def pushes(first: int, last: int, shifts: int) -> Iterator[Push]:
    """Yield the pushes of trucks: plain ones, light ones against other teeth, and those by a programme."""
    study = load_study("learned")
    assert study.study.truck is not None
    is_begun = [False]
    ended = Learned.ended

    def noting(self: Learned, *arguments: Any) -> None:
        is_begun[0] = self._is_begun
        ended(self, *arguments)

    setattr(Learned, "ended", noting)  # noqa: B010
    try:
        for number in range(first, last + 1):
            fleet = FleetTable(shifts=shifts, seed=SEED)
            truck = Truck(study.study.truck, study.study.factor, fleet, number, nominal(study, {}))
            rng, memory = np.random.default_rng(number), b""
            for drawn in truck.shifts()[0]:
                if drawn.known.get(f"{OWN}.rest_s", 60.0) < RESTED_S:
                    continue
                run = sampled(drawn.settings, OpenLoop)
                yield from push(run, drawn.settings, number, "plain")
                share = rng.uniform(*LIGHT_N_S) / drawn.impulse_n_s
                light = drawn.settings | {
                    "driveline.residual_rad_s": float(
                        share * drawn.settings["driveline.residual_rad_s"]
                    ),
                    "plant.mesh_force_n": float(TABLES_MESH_N * rng.uniform(0.88, 1.15)),
                }
                run = sampled(light, OpenLoop)
                yield from push(run, light, number, "light")
                run = sampled(
                    drawn.settings | drawn.known | {"controller.strategy": "learned"},
                    Learned,
                    memory,
                )
                memory = run[0].memory
                if is_begun[0]:
                    yield from push(run, drawn.settings, number, "programme")
    finally:
        setattr(Learned, "ended", ended)  # noqa: B010


def push(
    sampled: tuple[Run, list[tuple[float, float]], float],
    settings: Mapping[str, Any],
    truck: int,
    kind: str,
) -> Iterator[Push]:
    """Yield what was measured of a push, if it was released once."""
    run, found, began_s = sampled
    released = [each.time_s - began_s for each in run.record.events if each.name == "sync_unblock"]
    if len(released) != 1:
        return
    motion = Motion(PERIOD_S, STROKE_M, settings["plant.supply_pressure_pa"])
    for time_s, at_m in found:
        is_falling = time_s > released[0] - 2.0 * PERIOD_S
        motion.position([Sample(at_m, at_m, 0.0)], time_s, is_falling)
    yield Push(motion, released[0], settings, truck, kind)


def base_s(found: Sequence[Push]) -> dict[int, float]:
    """Return of each truck the mean onset of its plain pushes after valve and command: the age of its samples."""
    onsets = defaultdict[int, list[float]](list)
    for each in found:
        if each.kind != "programme" and each.motion.onset_s is not None:
            onsets[each.truck].append(each.motion.onset_s - each.settings["valve.D_rise"] - LATE_S)
    errors_ms = [1e3 * (one - np.mean(all_s)) for all_s in onsets.values() for one in all_s]
    print(f"onset of {len(errors_ms)} plain pushes: sd {np.std(errors_ms):.3f} ms")
    return {truck: float(np.mean(all_s)) for truck, all_s in onsets.items()}


def release(found: Sequence[Push], age_s: Mapping[int, float]) -> None:
    """Print the fit of the time from the release to a sample, in ms, after plain pushes and by programmes."""
    for is_plain, is_far in product((True, False), (False, True)):
        rows, times_ms = [], []
        for each in found:
            left = each.motion.left
            if left is None or (each.kind != "programme") != is_plain:
                continue
            at_s, beyond_m = left
            if (beyond_m >= FAR_M) == is_far:
                root = np.sqrt(1e3 * beyond_m)
                rows.append([1.0, root, 0.1 * root / each.released_s, root**2])
                times_ms.append(1e3 * (at_s - each.released_s - age_s[each.truck]))
        fitted, errors = fit(np.array(rows), np.array(times_ms))
        kind = f"{'plain' if is_plain else 'programme'}, {'far' if is_far else 'near'}"
        print(f"release, {kind}: {np.round(fitted, 3)}; {errors}")


def teeth(found: Sequence[Push], age_s: Mapping[int, float]) -> None:
    """Print the error of the meshing force that light pushes tell, of those that passed and that stopped."""
    errors: dict[bool, list[float]] = {True: [], False: []}
    for each in found:
        left = each.motion.released_s(each.released_s, True)
        if each.kind != "light" or left is None or each.motion.arrived_s is None:
            continue
        supply_pa = each.settings["plant.supply_pressure_pa"]
        # since the command, and with nominal valves: the opening delay is in both times
        since_s = left[0] - age_s[each.truck] + START_S - each.settings["valve.D_rise"] - LATE_S
        spent, _ = library().near(supply_pa).nearest.spent(since_s)
        travel_s = each.motion.arrived_s - left[0]
        share = heavier_by(spent, travel_s, supply_pa)
        if share is not None:
            true = each.settings["plant.mesh_force_n"] / TABLES_MESH_N - 1.0
            errors[travel_s > STOPPED_S].append(share[0] - true)
    for is_stopped, sizes in errors.items():
        print(f"meshing force, {'stopped' if is_stopped else 'passed'}: {len(sizes)} pushes, "
              f"mean {np.mean(sizes):.3f}, sd {np.std(sizes):.3f}")  # fmt: skip


def main(first: int, last: int, shifts: int) -> None:
    """Print all fits."""
    onset()
    found = list(pushes(first, last, shifts))
    age_s = base_s(found)
    release(found, age_s)
    teeth(found, age_s)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]))
