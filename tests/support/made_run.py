"""A small run made by hand, with every figure of merit known in advance."""

from __future__ import annotations

import numpy as np

from can_dbc import codec
from can_dbc.messages import (
    Chamber,
    ControllerStatus,
    Fault,
    Gear,
    PlantMotion,
    SafetyBlow,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from sil.coupling.bus import BusFrame
from sil.recording.run_record import PlantEvent, RunRecord

MS = 1_000_000
STROKE = 0.01285
REQUESTED, COMMANDED, OPENED, MOVES, ARRIVES = 100, 110, 118, 130, 150
BUS_DELAY_NS = 250_000
LAG_MS = 20


def true_position(time_ms: float) -> float:
    """Neutral to backward at constant speed from 130 to 150 ms."""
    share = min(max((time_ms - MOVES) / (ARRIVES - MOVES), 0.0), 1.0)
    return share * STROKE


def made() -> RunRecord:
    """Return a run of 400 ms in which the controller sees everything exactly 20 ms late."""
    frames = []

    def send(at_ms: int, message: object, sender: str, delay_ns: int) -> None:
        released = at_ms * MS
        frames.append(BusFrame(released, released + delay_ns, sender, codec.encode(message)))

    for now in range(0, 400, 10):
        gear = Gear.BACKWARD if now >= REQUESTED else Gear.NEUTRAL
        is_open = COMMANDED <= now < 200
        confirmed = Gear.BACKWARD if now >= ARRIVES + LAG_MS else Gear.NEUTRAL
        state = ShiftState.PUSH if is_open and now < 170 else ShiftState.IDLE
        if 170 <= now < 200:
            state = ShiftState.BLOW
        send(now, ShiftRequest(gear), "driver", BUS_DELAY_NS)
        send(now, ValveCommand(0.98 * is_open, 0.0, 0.0, gear), "controller", 2 * BUS_DELAY_NS)
        blows = 170 <= now < 200
        blow = SafetyBlow(Chamber.B if blows else Chamber.NONE, blows, 0.0)
        send(now, blow, "controller", 3 * BUS_DELAY_NS)
        status = ControllerStatus(state, confirmed, true_position(now - LAG_MS), Fault.NONE)
        send(now, status, "controller", 4 * BUS_DELAY_NS)
        moving = STROKE / 0.020 if MOVES < now < ARRIVES else 0.0
        motion = PlantMotion(true_position(now), moving, 0.0, 0.0)
        send(now, motion, "plant", 5 * BUS_DELAY_NS)
    frames.sort(key=lambda f: f.arrival_ns)

    time_s = np.arange(0, 4000) * 1e-4
    position = np.array([true_position(1e3 * t) for t in time_s])
    is_open = ((time_s >= 0.118) & (time_s < 0.2355)).astype(float)
    zero = np.zeros(len(time_s))
    truth = {
        "time_s": time_s,
        "position_m": position,
        "velocity_m_s": np.gradient(position, time_s),
        "piston_1_m": position + 0.013,
        "piston_2_m": zero,
        "input_rad_s": zero,
        "output_rad_s": zero,
        "pressure_B_pa": 1e5 + 8e5 * is_open,
        "pressure_N_pa": zero + 1e5,
        "pressure_F_pa": zero + 1.1e5,
        "valve_B": is_open,
        "valve_N": zero,
        "valve_F": zero,
        "cmd_B": 0.98 * ((time_s >= 0.110) & (time_s < 0.2005)),
        "cmd_N": zero,
        "cmd_F": zero,
    }
    events = [
        PlantEvent(0.118, "valve_B_open"),
        PlantEvent(
            0.150,
            "stay_stop",
            {"position_m": STROKE, "speed_m_s": 0.6425, "energy_j": 0.2, "peak_force_n": 4472.0},
        ),
        PlantEvent(0.2355, "valve_B_close"),
    ]
    return RunRecord(
        truth=truth,
        events=events,
        frames=frames,
        stroke_m=STROKE,
        free_travel_m=0.013,
        supply_pressure_pa=9e5,
        moving_mass_kg=1.1,
    )
