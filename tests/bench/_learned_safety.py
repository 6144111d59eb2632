"""Count the shifts in which strategy learned exceeds its limits, in trucks with faults.

python -m tests.bench._learned_safety FIRST LAST SHIFTS [KIND]

Trucks FIRST to LAST of the shipped population (seed `SEED`), each with one kind of fault in turn, or
all with `KIND`, "loose contact" of a driving valve and "late valve", one that is late from a shift on
without having been exchanged, among them; every second one gets other valves
after a third of its shifts. A shift is beyond the limits if it is more than 0.05 m/s harder or 30 ms
longer than the open loop under the same fault, or loses a gear that the open loop engages. Where the
fault ends the open loop's push, which may stop it softly, the impact is compared with the harder of the
open loop with and without the fault. The open loop is run only where the programme differs from the
plain push and the shift is not within the limits already against the plant alone under a push that goes
on (`plain_push`), which a fault of the controller's inputs can only end.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import beta

from controller.strategies.into_gear import PUSH
from controller.strategies.learned import Learned
from plant.node import CHAMBERS, PlantNode
from plant.parameters import ParameterSet
from sil.coupling.clock import to_ns
from sil.simulation import build
from sil.simulation.in_memory import Run, run_in_memory
from sil.studies.fleet import OWN, Drawn, FleetTable, Truck
from sil.studies.kinds.learned import (
    DID_NOT_ARRIVE,
    HARDER_M_S,
    LONGER_S,
    Outcome,
    nominal,
    outcome,
    run_shifts,
)
from sil.studies.load_study import load_study
from sil.studies.study import texts_of

SEED = 19
HIT = 0.3
"""Share of the shifts that a fault hits which is not there for good."""
UNCONFIRMED = "not confirmed: the sensor failed before"
"""A gear that is engaged, but the position's reports fail within the shift: counted separately."""
OF_POSITION = "position", "frames lost"
MOVES = {
    f"valve_{name}_{move}": (chamber, position)
    for chamber, name in enumerate(CHAMBERS)
    for move, position in (("open", 1.0), ("close", 0.0))
}
"""Chamber and position of each move of a valve, by its event."""
NEUTRAL = CHAMBERS.index("N")
ARRIVED_M = 0.012
"""A stop of the stay that is further from neutral is in a gear."""
CERTAIN = 1e-5
"""By so many m/s and s a shift is within the limits against the plant alone to be so without doubt."""
SHORT_S = 0.24, 0.32
"""Simulated times of a shift from its request on: the first one in which the gear is confirmed is enough."""
NOTICED_S = 0.02
"""Speeds that fail before this were wrong in the last gear, too: a run begins in neutral, with the first
reports, but the truck and its unit were on before it."""
KINDS = ("none", "update missed", "memory damaged", "thermometer", "speeds", "position", "valve",
         "frames lost", "supply late", "exchanged valve")  # fmt: skip
LOOSE, LATE = "loose contact", "late valve"
EXCHANGED = {"kind": "delayed", "delay_s": 0.003}
THERMOMETER = (
    {"kind": "stuck", "value_k": 253.15},
    {"kind": "stuck", "value_k": 293.15},
    {"kind": "stuck", "value_k": 353.15},
    {"kind": "wrong", "offset_k": 20.0},
    {"kind": "wrong", "offset_k": -20.0},
    {"kind": "off"},
    {"kind": "garbage"},
    {"kind": "intermittent"},
)
SPEEDS = "delayed", "garbage", "intermittent", "off", "slow", "stuck", "wrong"
POSITION = "delayed", "garbage", "intermittent", "off", "slow", "stuck", "wrong"
VALVE = ({"kind": "slow", "factor": 1.2}, {"kind": "slow", "factor": 1.5}, {"kind": "intermittent"},
         {"kind": "delayed", "delay_s": 0.003}, {"kind": "off"})  # fmt: skip
MESSAGES = "DrivelineSpeeds", "PositionPulse"


def faulty(kind: str, drawn: list[Drawn], rng: np.random.Generator) -> Iterator[Drawn]:
    """Yield the shifts of a truck with a kind of fault: some of them, or all from a shift on."""
    begin = int(rng.integers(len(drawn)))
    thermometer = THERMOMETER[rng.integers(len(THERMOMETER))]
    valve = VALVE[rng.integers(len(VALVE))] | {"valve": "BNF"[rng.integers(3)]}
    for k, each in enumerate(drawn):
        start_s, hit = float(rng.uniform(0.0, 0.35)), rng.random() < HIT
        known, added = each.known, dict[str, Any]()
        if kind == "thermometer" and k >= begin:
            added["temperature_fault"] = [thermometer]
        elif kind == "valve" and k >= begin:
            added["valve_fault"] = [valve]
        elif kind == LOOSE and k >= begin:
            added["valve_fault"] = [{"kind": "intermittent", "valve": "BF"[begin % 2]}]
        elif kind == "supply late":
            known = known | {f"{OWN}.supply_pa": drawn[max(0, k - 5)].known[f"{OWN}.supply_pa"]}
        elif kind in ("exchanged valve", LATE) and k >= begin:
            added["valve_fault"] = [EXCHANGED | {"valve": valve["valve"]}]
            if k == begin and kind != LATE:  # the unit was off meanwhile
                known = known | {f"{OWN}.speeds_agreed": False}
        elif kind == "speeds" and hit:
            known = known | {f"{OWN}.speeds_agreed": start_s >= NOTICED_S}
            added["speed_fault"] = [{"kind": str(rng.choice(SPEEDS)), "start_s": start_s}]
        elif kind == "position" and hit:
            added["sensor_fault"] = [{"kind": str(rng.choice(POSITION)), "start_s": start_s}]
        elif kind == "frames lost" and hit:
            lost = {"kind": "loss", "message": str(rng.choice(MESSAGES)), "probability": 0.5}
            added["fault"] = [lost | {"start_s": start_s}]
        yield replace(each, settings=each.settings | added, known=known)


def recalled(kind: str, before: bytes, after: bytes, rng: np.random.Generator) -> bytes:
    """Return the memory with which the next shift begins: that before a shift, or damaged, at times."""
    if kind == "update missed" and rng.random() < HIT:
        return before
    if kind == "memory damaged" and rng.random() < HIT and after:
        bits = np.unpackbits(np.frombuffer(after, np.uint8))
        bits[rng.integers(len(bits), size=rng.integers(1, 20))] ^= 1
        return np.packbits(bits).tobytes()[: rng.integers(1, len(after) + 1)]
    return after


def lengths(drawn: Drawn) -> Iterator[Drawn]:
    """Yield a shift that is simulated until most, then all ordinary ones are confirmed, then the whole one."""
    begin_s = drawn.settings["request"][0]["at_s"]
    for short_s in SHORT_S:
        yield replace(drawn, settings=drawn.settings | {"duration_s": begin_s + short_s})
    yield drawn


def plain_push(run: Run, parameters: ParameterSet, impulse_n_s: float) -> tuple[float, float]:
    """Return impact in m/s and time in s of the plant of a run if neutral had not been filled.

    The valves of the gears move as in the run; impacts other than the stay's stop are not counted. So the
    open loop is not softer, and later only by a fault. Zeros if the stay does not arrive.
    """
    stroke = PlantNode(build.plant_config(run.scenario), parameters).stroke
    switches, filled = [], False
    for event in run.record.events:
        if event.name in MOVES:
            chamber, position = MOVES[event.name]
            filled |= chamber == NEUTRAL and position == 1.0
            if chamber != NEUTRAL or not filled:
                switches.append((to_ns(event.time_s), chamber, position))
    stroke.advance(0)
    stroke.set_sync_impulse(impulse_n_s)
    stroke.advance(to_ns(run.scenario.duration_s), switches)
    stops = [
        each for each in stroke.events if each.name == "stop" and abs(each.position_m) > ARRIVED_M
    ]
    if not stops:
        return 0.0, 0.0
    return max(each.speed_m_s for each in stops), stops[0].time_s - run.shifts[-1].requested_s


def is_within(found: Outcome, impact_m_s: float, time_s: float) -> bool:
    """Return whether a shift is within the limits against an impact and a time without doubt."""
    harder_m_s, longer_s = found.impact_m_s - impact_m_s, found.time_s - time_s
    return harder_m_s < HARDER_M_S - CERTAIN and longer_s < LONGER_S - CERTAIN


def broken(found: Outcome, open_loop: Outcome, impact_m_s: float) -> str:
    """Return what of a shift is beyond the limits against the open loop, empty if nothing is.

    impact_m_s: of the open loop; if the fault ends its push, the harder one of with and without.
    """
    harder_m_s, longer_s = found.impact_m_s - impact_m_s, found.time_s - open_loop.time_s
    if found.lost and not open_loop.lost:
        return found.lost if found.lost == DID_NOT_ARRIVE else UNCONFIRMED
    if harder_m_s > HARDER_M_S:
        return f"{harder_m_s:.3f} m/s harder"
    return f"{1e3 * longer_s:.0f} ms longer" if not found.lost and longer_s > LONGER_S else ""


def beyond(number: int, shifts: int, kind: str) -> Iterator[tuple[int, bool, str]]:
    """Yield number, whether a programme was followed, and what is beyond the limits of each shift."""
    study = load_study("learned")
    assert study.study.truck is not None
    acted: list[bool] = []
    plain = Learned.decide

    def noting(self: Learned, *arguments: Any) -> Any:
        command = plain(self, *arguments)
        acted.append(command != PUSH)
        return command

    rng = np.random.default_rng([SEED, number])
    fleet = FleetTable(shifts=shifts, seed=SEED, exchanged_at=shifts // 3)
    truck = Truck(study.study.truck, study.study.factor, fleet, number, nominal(study, {}))
    memory, own = b"", {"controller.strategy": "learned"}
    try:
        setattr(Learned, "decide", noting)  # noqa: B010
        drawn = truck.shifts()[0]
        for k, (healthy, each) in enumerate(zip(drawn, faulty(kind, drawn, rng), strict=True), 1):
            acted.clear()
            for shift in lengths(each):
                what = ""
                loaded = study.loaded(texts_of({**shift.settings, **shift.known, **own}))
                run = run_in_memory(loaded, memory)
                found = outcome(run)
                if any(acted) and not is_within(
                    found, *plain_push(run, loaded.parameters, shift.impulse_n_s)
                ):
                    (open_loop,) = run_shifts(study.loaded, {}, [shift])
                    impact_m_s = open_loop.impact_m_s
                    if open_loop.lost:
                        (whole,) = run_shifts(study.loaded, {}, [healthy])
                        impact_m_s = max(impact_m_s, whole.impact_m_s)
                    what = broken(found, open_loop, impact_m_s)
                if not (found.lost or what):
                    break
            memory = recalled(kind, memory, found.memory, rng)
            yield k, any(acted), what
    finally:
        setattr(Learned, "decide", plain)  # noqa: B010


def main(first: int, last: int, shifts: int, only: str = "") -> None:
    """Print each shift beyond the limits, and after each truck the count of all until then."""
    if only not in ("", LOOSE, LATE, *KINDS):
        sys.exit(f"KIND: {only!r}; expected one of {', '.join((LOOSE, LATE, *KINDS))}")
    run, acted, unconfirmed, bad = Counter[str](), 0, 0, Counter[str]()
    for number in range(first, last + 1):
        kind = only or KINDS[number % len(KINDS)]
        for k, programme, what in beyond(number, shifts, kind):
            run[kind] += 1
            acted += programme
            if what == UNCONFIRMED and kind in OF_POSITION:
                unconfirmed += 1
            elif what:
                bad[kind] += 1
                print(f"truck {number} ({kind}), shift {k}: {what}", flush=True)
        total, wrong = run.total(), bad.total()
        most = beta.ppf(0.95, wrong + 1, total - wrong)
        print(f"{number}: {total} shifts, {acted} by a programme, {wrong} beyond the limits, "
              f"{unconfirmed} not confirmed by a sensor that failed; "
              f"rate below {most:.1e} (95 %); {dict(bad)} of {dict(run)}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]), *sys.argv[4:5])
