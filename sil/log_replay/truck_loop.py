"""Our firmware and plant in closed loop, in place of the truck's, for one recorded shift.

The engine is the truck's: its torque cut, when and how fast it synchronises, the torque's return after the
engagement. The actuator is ours: our control unit gets the request at the recorded torque cut, and the
plant's cone takes the speed difference that the engine has left when the stay gets there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.messages import GEAR_PARK, ControllerStatus, Fault
from sil.files.overrides import Settings
from sil.log_replay.truck_shift import PHASES, SYNCHRONISED_RAD_S, RecordedShift, peak_rate
from sil.report.figure import Floats
from sil.simulation import load_scenario
from sil.simulation.in_memory import Run, run_in_memory

REQUEST_S: Final = 0.4
"""Simulated time of our request: the firmware is ready, and a request frame is due."""


class Input(NamedTuple):
    """A value that a simulation of a shift rests on, and where it is from."""

    path: str
    value: float | str
    source: str
    text: str


@dataclass(frozen=True)
class OurShift:
    """The same shift by our firmware and plant; times in s after the recorded request.

    time_s, position_m, difference_rad_s: [n] the stay and the speeds at the synchronizer.
    reached: the gear was confirmed. left_rad_s, impulse_n_s: what the cone took, and its impulse.
    """

    times_s: dict[str, float | None]
    reached: bool
    faults: str
    impact_speed_m_s: float | None
    impact_energy_j: float | None
    peak_rad_s2: float | None
    left_rad_s: float | None
    impulse_n_s: float | None
    time_s: Floats
    position_m: Floats
    difference_rad_s: Floats


def why_not(recorded: RecordedShift) -> str | None:
    """Return why a shift has no counterpart on our actuator, None if it has one."""
    before, after = recorded.shift.from_gear, recorded.shift.to_gear
    if before is None or after is None:
        return "the gears are not known"
    if GEAR_PARK in (before, after):
        return "park is no position of the actuator"
    return "the gear is the same before and after" if before == after else None


def side(gear: int) -> str:
    """Return the position of our stay for a gear: odd ones forward, even ones and none backward."""
    if gear == 0:
        return "neutral"
    return "forward" if gear % 2 else "backward"


def inputs_of(recorded: RecordedShift) -> list[Input]:
    """Return all values of the simulation that depend on the shift, or are assumed for it."""
    from_gear, to_gear = recorded.shift.from_gear, recorded.shift.to_gear
    assert from_gear is not None
    assert to_gear is not None
    before, after = side(from_gear), side(to_gear)
    text = f"gear {from_gear}: odd gears forward, even gears backward"
    if before == after:
        before = "backward" if after == "forward" else "forward"
        text = f"gear {from_gear}: the opposite side, though the parity is the same"
    return [
        Input("initial_gear", before, "default", text),
        Input("request.gear", after, "default", f"gear {to_gear}"),
        _request(recorded),
        _supply(recorded),
        _pull(recorded),
        Input("plant.mesh_force_n", 500.0, "default", "not recorded; as in truck_into_gear_easy"),
        *_driveline(recorded),
    ]


def _request(recorded: RecordedShift) -> Input:
    path, times = "request.after_s", recorded.times_s
    cut, agree = times["torque_cut"], times["synchronised"]
    if not recorded.shift.from_gear and agree is not None and agree >= (cut or 0.0):
        return Input(path, agree, "log", "from neutral: when the recorded speeds agree")
    if cut is not None:
        return Input(path, cut, "log", "at the recorded torque cut")
    if times["disengaged"] is not None:
        text = "torque cut not known: so that both leave the gear at the same instant"
        return Input(path, "as the gear is left", "default", text)
    return Input(path, 0.0, "default", "neither torque cut nor leaving the gear known: at once")


def _supply(recorded: RecordedShift) -> Input:
    path, pressure = "plant.supply_pressure_pa", recorded.signals["supply_pressure_pa"]
    if pressure is None:
        return Input(path, "nominal", "default", "no supply pressure in the log; the model's")
    value = float(np.median(pressure.values))
    if not 4e5 <= value <= 1.6e6:
        text = f"{pressure.origin}: {value * 1e-5:.2f} bar is no working pressure; the model's"
        return Input(path, "nominal", "default", text)
    return Input(path, value, "log", pressure.origin)


def _pull(recorded: RecordedShift) -> Input:
    path, torque = "plant.pull_force_n", recorded.signals["engine_torque_share"]
    free_n = 100.0  # without torque, as in the scenarios truck_*_easy
    cut = recorded.times_s["torque_cut"]
    if torque is None or cut is None:
        return Input(path, free_n, "default", "torque at the cut not known; teeth nearly free")
    at_cut = float(torque.values[np.searchsorted(torque.time_s, cut)])
    # the teeth slide under the torque that the engine has left of its reference torque
    friction, reference_n_m, radius_m = 0.1, 2000.0, 0.06
    return Input(
        path, free_n + friction * reference_n_m * abs(at_cut) / radius_m, "derived",
        f"{free_n:g} N + {friction:g} * {abs(at_cut):.0%} of {reference_n_m:g} N m / {radius_m:g} m; "
        f"torque at the cut from {torque.origin}",
    )  # fmt: skip


def _driveline(recorded: RecordedShift) -> list[Input]:
    sync = recorded.synchronisation
    if recorded.shift.to_gear == 0:
        return []
    if sync is None:
        text = "speeds of this shift not known; the driveline's defaults"
        return [Input("driveline", "defaults", "default", text)]
    text = (
        f"main shaft: median output speed * {sync.main_by_output:g}, the range section's ratio "
        f"assumed for the gear's ratio {sync.new_ratio:.3f}"
    )
    output = Input("driveline.output_rad_s", sync.main_rad_s, "derived", text)
    if not recorded.shift.from_gear:
        after = recorded.times_s["synchronised"] or 0.0
        value = float(np.interp(after, sync.time_s, sync.difference_rad_s))
        text = "speed difference at our request"
        return [output, Input("driveline.residual_rad_s", value, "log", text)]
    text = (
        f"main shaft speed * ({sync.old_ratio:.3f} / {sync.new_ratio:.3f} - 1), ratios of the log"
    )
    step = Input("driveline.gear_step_rad_s", sync.step_rad_s, "derived", text)
    if sync.ramp_rad_s2 is None or sync.delay_s is None:
        text = "fall of the difference not known; the driveline's default"
        return [output, step, Input("driveline.engine_ramp_rad_s2", "default", "default", text)]
    text = (
        "straight line through the recorded difference, 90 to 10 %, at most "
        f"{sync.apart_rad_s:.1f} rad/s apart; taken as the engine's alone"
    )
    return [
        output,
        step,
        Input("driveline.engine_delay_s", sync.delay_s, "derived", "from leaving the gear on"),
        Input("driveline.engine_ramp_rad_s2", sync.ramp_rad_s2, "derived", text),
    ]


def scenario_of(inputs: Sequence[Input]) -> dict[str, Any]:
    """Return the scenario of a shift with these inputs, as a table."""
    table: dict[str, Any] = {"plant": {"mounted": True}, "driveline": {}}
    values = {entry.path: entry.value for entry in inputs}
    for path, value in values.items():
        section, _, name = path.partition(".")
        if section in table and name and not isinstance(value, str):
            table[section][name] = value
    driveline = table["driveline"]
    ramp = driveline.get("engine_ramp_rad_s2", 150.0)
    falls_s = abs(driveline.get("gear_step_rad_s", 0.0)) / ramp
    falls_s += driveline.get("engine_delay_s", 0.0)
    return table | {
        "name": "shift of a truck's log",
        "duration_s": min(REQUEST_S + 2.6 + falls_s, 8.0),
        "initial_gear": values["initial_gear"],
        "request": [{"at_s": REQUEST_S, "gear": values["request.gear"]}],
        "controller": {},
    }


def simulate(
    recorded: RecordedShift,
    inputs: Sequence[Input],
    source: str,
    table: Mapping[str, Any],
    settings: Settings,
) -> OurShift:
    """Run a shift with our firmware and plant.

    `table`: keys of the scenario that replace those of the shift. Raises InputError for a wrong
    setting.
    """
    loaded = load_scenario.from_table(scenario_of(inputs) | dict(table), source, settings=settings)
    run = run_in_memory(loaded)
    after = next(entry.value for entry in inputs if entry.path == "request.after_s")
    driveline = loaded.scenario.driveline
    block_m = float(loaded.parameters.value("synchronizer.x_block"))
    truth, left = run.record.truth, recorded.times_s["disengaged"]
    passed = (truth["time_s"] >= REQUEST_S) & (np.abs(truth["position_m"]) < block_m)
    offset_s = -REQUEST_S if isinstance(after, str) else after - REQUEST_S
    if isinstance(after, str) and left is not None and passed.any():
        offset_s = left - float(truth["time_s"][np.argmax(passed)])
    n_s_per_rad_s = driveline.inertia_kg_m2 / driveline.cone_gain_m
    return _measured(recorded, run, offset_s, block_m, n_s_per_rad_s)


def _measured(
    recorded: RecordedShift, run: Run, offset_s: float, block_m: float, n_s_per_rad_s: float
) -> OurShift:
    truth, figures = run.record.truth, run.shifts[0]
    time, position = truth["time_s"], truth["position_m"]
    difference = truth["input_rad_s"] - truth["output_rad_s"]
    started = time >= REQUEST_S

    def first(condition: NDArray[np.bool_]) -> float | None:
        instants = time[started & condition]
        return float(instants[0]) + offset_s if len(instants) else None

    disengaged = synchronised = left = peak = engaged = back = None
    if recorded.shift.from_gear:
        disengaged = first(np.abs(position) < block_m)
    if recorded.shift.to_gear and recorded.synchronisation is not None:
        apart = np.flatnonzero(started & (np.abs(difference) > SYNCHRONISED_RAD_S))
        if not len(apart):
            synchronised = REQUEST_S + offset_s
        elif apart[-1] + 1 < len(time):
            synchronised = float(time[apart[-1] + 1]) + offset_s
        blocked = np.flatnonzero(started & (truth["spent_impulse_n_s"] > 0.0))
        left = abs(float(difference[blocked[0]])) if len(blocked) else None
    if disengaged is not None and synchronised is not None:
        peak = peak_rate(time + offset_s, difference, disengaged + 0.011, synchronised + 0.1)
    theirs = recorded.times_s
    if figures.confirmed_s is not None:
        engaged = figures.confirmed_s + offset_s
        if theirs["torque_back"] is not None and theirs["engaged"] is not None:
            back = engaged + theirs["torque_back"] - theirs["engaged"]
    instants = (theirs["torque_cut"], disengaged, synchronised, engaged, back)
    raised = Fault.NONE
    for _, status in run.record.of(ControllerStatus):
        raised |= status.faults
    return OurShift(
        times_s=dict(zip(PHASES, instants, strict=True)),
        reached=engaged is not None,
        faults="|".join(fault.name or "" for fault in raised),
        impact_speed_m_s=figures.impact_speed_m_s,
        impact_energy_j=figures.impact_energy_j,
        peak_rad_s2=peak,
        left_rad_s=left,
        impulse_n_s=None if left is None else left * n_s_per_rad_s,
        time_s=time[started] + offset_s,
        position_m=position[started],
        difference_rad_s=difference[started],
    )
