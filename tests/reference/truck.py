"""A truck's CAN log from the judge's actuators: own push logic, own sensor timing, own driveline.

Frames follow the contract (can_dbc); nothing else is shared with plant or controller. A truck differs
from the nominal set by its tolerances; its shifts scatter as the set's section `repeatability` states.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from can_dbc.codec import encode
from can_dbc.e2e import PROTECTED, Protector
from can_dbc.frame import Frame
from can_dbc.messages import (
    Air1,
    Chamber,
    DrivelineSpeeds,
    Gear,
    Message,
    PositionPulse,
    SafetyBlow,
    ValveCommand,
)
from sil.logs import LogFrame, open_writer
from tests.reference import parts
from tests.reference.actuator import Case
from tests.reference.changed import Change, ChangedLength

GEARS = {"N": Gear.NEUTRAL, "B": Gear.BACKWARD, "F": Gear.FORWARD}
DUTY = 0.98
NEAR_M, NEAR_PULSES = 1e-3, 3
BLOW_S = 0.15
LONGEST_S = 2.0
CAPTURE_S = 0.0015
FRAME_S = 0.00026
OUTPUT_RAD_S = 80.0
PERIOD_S = 0.01


class StalledError(Exception):
    """A shift that does not arrive."""


@dataclass(frozen=True)
class Truck:
    """What makes a truck differ from the nominal one, and what its bus carries.

    values: changed numbers of the set. change: of all shifts, the cause included. cone_n_s_rad:
    impulse by speed difference. varying: loads are drawn for each shift, not once. speeds: the shaft
    speeds are on the bus. air: so is the supply pressure.
    """

    values: dict[str, float]
    change: Change
    supply_pa: float
    cone_n_s_rad: float
    phase_s: float
    speeds: bool = True
    varying: bool = False
    air: bool = False
    mesh_n: tuple[float, float] = (500.0, 1300.0)
    pull_n: tuple[float, float] = (0.0, 1100.0)
    impulse_n_s: tuple[float, float] = (18.0, 78.0)


def drawn_truck(rng: np.random.Generator, cause: Change, **layout: bool) -> Truck:
    """Draw a truck with a cause; loads within the set's typical ranges."""
    v = parts.nominal()

    def unit(name: str) -> float:
        return float(v[f"repeatability.unit_{name}_sd"]) * rng.normal()

    def combined(name: str, own: float) -> float:
        return float(cause.get(name, 1.0)) * own

    delay = "valve_delay"
    change = dict(cause)
    change["friction"] = combined("friction", 1.0 + unit("friction"))
    change["open_later_s"] = cause.get("open_later_s", 0.0) + unit(delay)
    change["close_later_s"] = cause.get("close_later_s", 0.0) + 3.0 * unit(delay)
    change["inlet"] = combined("inlet", 1.0 + unit("flow"))
    change["outlet"] = combined("outlet", 1.0 + unit("flow"))
    for name in ("outer_volume", "inner_volume"):
        change[name] = cause.get(name, 0.0) + unit("volume")
    values = {
        "truck.m_gearbox": float(v["truck.m_gearbox"] * np.exp(0.1 * rng.normal())),
        "truck.F_gearbox": float(v["truck.F_gearbox"] * np.exp(0.15 * rng.normal())),
    }
    truck = Truck(
        values,
        change,
        float(v["supply.P_s"]) * (1.0 + 0.01 * rng.normal()),
        float(0.25 / 0.09 * np.exp(0.15 * rng.normal())),
        rng.uniform(0.0, PERIOD_S),
        **layout,
    )
    if truck.varying:
        return truck
    mesh, pull = (float(rng.uniform(*limits)) for limits in (truck.mesh_n, truck.pull_n))
    return Truck(**{**vars(truck), "mesh_n": (mesh, mesh), "pull_n": (pull, pull)})


@dataclass
class _Bus:
    """Frames of a log, by message and in time."""

    rng: np.random.Generator
    frames: list[tuple[float, Frame]] = field(default_factory=list)
    protectors: dict[type, Protector] = field(default_factory=dict)

    def send(self, at_s: float, message: Message) -> None:
        """Send a message; one frame in five waits for another one."""
        kind = type(message)
        if kind in PROTECTED:
            frame = self.protectors.setdefault(kind, Protector(kind)).protect(message)
        else:
            frame = encode(message)
        waits = self.rng.uniform(0.0, FRAME_S) * (self.rng.uniform() < 0.2)
        self.frames.append((at_s + FRAME_S + waits, frame))


@dataclass(frozen=True)
class Pushed:
    """One shift: its kind, such as N-B, impulse of its cone; begin_s: command at the valve; off_s: the tick that ends it."""

    kind: str
    impulse_n_s: float
    difference_rad_s: float
    begin_s: float
    off_s: float


@dataclass(frozen=True)
class Drive:
    """Motion of a drive, time_s, position_m, difference_rad_s [n], and its commands: (tick s, chamber or -1)."""

    time_s: np.ndarray
    position_m: np.ndarray
    difference_rad_s: np.ndarray
    commands: list[tuple[float, int]]
    shifts: list[Pushed]


def moved(
    truck: Truck, kind: str, impulse: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times from the first command on, positions, and impulse spent of one shift; StalledError if it does not arrive."""
    v = parts.nominal(truck.values)
    own = dict(truck.change)
    own["friction"] *= 1.0 + v["repeatability.friction_sd"] * rng.normal()
    for name in ("open_later_s", "close_later_s"):
        own[name] += v["repeatability.valve_delay_sd"] * rng.normal()
    scatter = 1.0 + v["repeatability.supply_sd"] * rng.normal()
    own["supply"] = (1.0 + own.get("supply", 0.0)) * scatter - 1.0
    own = {name: float(value) for name, value in own.items()}
    chamber = "N" if kind[-1] == "N" else kind[-1]
    load = float(rng.uniform(*(truck.mesh_n if kind[0] == "N" else truck.pull_n)))
    case = Case(
        kind, truck.supply_pa, ((0.0, chamber, DUTY),), (), None, mounted=True,
        mesh_force_n=load, sync_impulse_n_s=impulse,
    )  # fmt: skip
    end = {"N": 0.0, "B": 1.0, "F": -1.0}[kind[-1]] * v["length.stroke"]
    for duration in (0.35, LONGEST_S):
        times = np.arange(round(duration / 2.5e-4)) * 2.5e-4
        for rtol, step in ((1e-6, 5e-3), (1e-8, 1e-3), (1e-10, 3e-4)):
            actuator = ChangedLength(v, case, own)
            try:
                states = actuator.solve(times, rtol=rtol, max_step=step).states
                break
            except (
                ValueError,
                AssertionError,
            ):  # the solver lost an event in rounding: smaller steps
                continue
        else:
            raise StalledError("no solution")
        if np.all(np.abs(states[-100:, 0] - end) < NEAR_M):
            return times, states[:, 0], states[:, actuator.spent]
    raise StalledError(kind)


def drive(truck: Truck, shifts: int, rng: np.random.Generator) -> Drive:
    """Shifts one by one: pushed until three pulses show the gear, then blown; StalledError if one does not arrive."""
    times, positions, differences = [np.array([0.0])], [np.array([0.0])], [np.array([0.0])]
    commands: list[tuple[float, int]] = []
    pushed: list[Pushed] = []
    gear, at_s = "N", 0.4
    stroke = float(parts.nominal()["length.stroke"])
    for _ in range(shifts):
        target = str(rng.choice(["B", "F"])) if gear == "N" else "N"
        impulse = float(rng.uniform(*truck.impulse_n_s)) if target != "N" else 0.0
        tick = np.ceil(at_s / PERIOD_S) * PERIOD_S
        begin = tick + FRAME_S
        time_s, x, spent = moved(truck, f"{gear}-{target}", impulse, rng)
        cone = truck.cone_n_s_rad * (1.0 + 0.04 * rng.normal())
        before = impulse / cone * float(rng.choice((-1.0, 1.0)))
        if target != "N":  # the engine has synchronised to what the cone has to take
            differences[-1][-1] = before
            difference_rad_s = before * (1.0 - np.minimum(spent / impulse, 1.0))
            difference_rad_s[np.abs(x) < 0.005] = before
        else:
            difference_rad_s = np.zeros(len(x))
        times.append(begin + time_s)
        positions.append(x)
        differences.append(difference_rad_s)
        end = {"N": 0.0, "B": stroke, "F": -stroke}[target]
        pulses = truck.phase_s + PERIOD_S * (
            np.ceil((begin - truck.phase_s) / PERIOD_S) + np.arange(LONGEST_S / PERIOD_S)
        )
        near = np.abs(np.interp(pulses - begin, time_s, x) - end) < NEAR_M
        sure = np.flatnonzero(np.convolve(near, np.ones(NEAR_PULSES), "valid") == NEAR_PULSES)[0]
        confirmed = pulses[sure + NEAR_PULSES - 1] + CAPTURE_S + FRAME_S
        off = np.ceil((confirmed + BLOW_S) / PERIOD_S) * PERIOD_S
        commands += [(tick, "BNF".index("N" if target == "N" else target)), (off, -1)]
        pushed.append(Pushed(f"{gear}-{target}", impulse, before, begin, off))
        at_s = off + float(rng.uniform(0.45, 0.7))
        gear = target
    times.append(np.array([at_s]))
    positions.append(positions[-1][-1:])
    differences.append(differences[-1][-1:])
    return Drive(*map(np.concatenate, (times, positions, differences)), commands, pushed)


def write_log(path: Path, truck: Truck, shifts: int, rng: np.random.Generator) -> None:
    """Write the log of a drive. Raises StalledError if a shift does not arrive."""
    write_drive(path, truck, drive(truck, shifts, rng), rng)


def write_drive(path: Path, truck: Truck, driven: Drive, rng: np.random.Generator) -> None:
    """Write the log of what was driven."""
    v, bus, end = parts.nominal(), _Bus(rng), driven.time_s[-1]
    chamber, queue = -1, list(driven.commands)
    for tick in np.arange(1, int(end / PERIOD_S)) * PERIOD_S:
        while queue and queue[0][0] <= tick + 1e-6:
            chamber = queue.pop(0)[1]
        duties = [DUTY * (k == chamber) for k in range(3)]
        gear = Gear.UNKNOWN if chamber < 0 else list(GEARS.values())[(1, 0, 2)[chamber]]
        bus.send(tick, ValveCommand(*duties, gear))
        bus.send(tick, SafetyBlow(Chamber.NONE, False, 0.0))
        if truck.speeds:
            index = np.searchsorted(driven.time_s, tick - 0.003)
            known = float(driven.difference_rad_s[max(index - 1, 0)]) + 0.1 * rng.normal()
            bus.send(tick - 0.003, DrivelineSpeeds(OUTPUT_RAD_S + known, OUTPUT_RAD_S))
    change = truck.change
    warm = 1.0 + v["position_sensor.temp_coeff"] * change.get("warmer_k", 0.0)
    tick, mid = v["position_sensor.timer_resolution"], v["position_sensor.t_mid"]
    for number, start in enumerate(truck.phase_s + PERIOD_S * np.arange(int(end / PERIOD_S) - 1)):
        x = np.interp(start + 0.5 * mid, driven.time_s, driven.position_m)
        x *= 1.0 + change.get("gain", 0.0)
        shaken = (mid + v["position_sensor.slope"] * x) * warm + 2e-7 * rng.normal()
        pulse = PositionPulse(round(shaken / tick) * tick, 293.15, number % 256)
        bus.send(start + CAPTURE_S + change.get("later_s", 0.0), pulse)
    if truck.air:
        for at_s in np.arange(0.1, end, 1.0):
            bus.send(at_s, Air1(truck.supply_pa - v["gas.P_atm"]))
    with open_writer(str(path)) as writer:
        for at_s, frame in sorted(bus.frames, key=lambda item: item[0]):
            writer.write(LogFrame(round(1e9 * at_s), frame.can_id, frame.data))
