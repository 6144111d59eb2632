"""A light model of an engagement, in plain floats, and its observer; positions in m from neutral towards the gear.

One driving piston, the stay it pushes, the neutral chamber it compresses. Ellipses stand for the measured flows, the
far chamber is at the atmosphere, no synchronizer: its force is what the observer finds.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Annotated

from controller.position import position_filter
from controller.settings import ControlConfig, Settings, bounded


class ModelSettings(Settings, frozen=True):
    """What the light model takes for true; the defaults are the laboratory's length stroke."""

    supply_pa: Annotated[float, bounded(2e5, 1.5e6, "Pa")] = 9e5
    atmosphere_pa: Annotated[float, bounded(5e4, 1.2e5, "Pa")] = 101325.0
    valve_open_s: Annotated[float, bounded(0.0, 0.1, "s")] = 0.008
    valve_close_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.035
    transport_s: Annotated[float, bounded(0.0, 0.02, "s")] = 0.00038
    """From the start of a step to the command's arrival at the valve driver."""
    stay_kg: Annotated[float, bounded(0.05, 100.0, "kg")] = 0.9
    piston_kg: Annotated[float, bounded(0.01, 10.0, "kg")] = 0.2
    stay_friction_n: Annotated[float, bounded(0.0, 2000.0, "N")] = 22.0
    piston_friction_n: Annotated[float, bounded(0.0, 2000.0, "N")] = 29.0
    stay_damping_n_s_m: Annotated[float, bounded(0.0, 1000.0, "N s/m")] = 17.0
    piston_damping_n_s_m: Annotated[float, bounded(0.0, 1000.0, "N s/m")] = 22.0
    piston_m2: Annotated[float, bounded(1e-5, 0.1, "m2")] = 0.00251327412
    stay_m2: Annotated[float, bounded(0.0, 0.1, "m2")] = 0.000314159265
    gap_m: Annotated[float, bounded(0.0, 0.1, "m")] = 0.013
    """Way of the piston before it meets the stay."""
    driving_m3: Annotated[float, bounded(1e-7, 0.01, "m3")] = 2.8e-5
    braking_m3: Annotated[float, bounded(1e-5, 0.01, "m3")] = 9.2968e-5
    """Volumes of the driving chamber and of neutral, both when in neutral."""
    filling_alpha_flow: Annotated[float, bounded(0.5, 2.0, "")] = 0.94
    filling_alpha_volume: Annotated[float, bounded(0.5, 2.0, "")] = 0.87
    venting_alpha_flow: Annotated[float, bounded(0.5, 2.0, "")] = 1.5
    venting_alpha_volume: Annotated[float, bounded(0.5, 2.0, "")] = 1.05
    """Exponents of the state change (thesis table 3.2)."""
    flow_in: Annotated[float, bounded(0.0, 1e-3, "K kg/(s Pa)")] = 2.27e-6
    flow_in_critical: Annotated[float, bounded(-2.0, 0.9, "")] = -0.605
    flow_out: Annotated[float, bounded(0.0, 1e-3, "K kg/(s Pa)")] = 2.42e-6
    flow_out_critical: Annotated[float, bounded(-2.0, 0.9, "")] = 0.281


@dataclass(slots=True)
class LightModelState:
    """State of the light model: piston from its stop, stay from neutral, pressures, load on it."""

    driving_pa: float
    braking_pa: float
    piston_m: float = 0.0
    piston_m_s: float = 0.0
    stay_m: float = 0.0
    stay_m_s: float = 0.0
    load_n: float = 0.0

    def rest(self, pressure_pa: float) -> None:
        """Return to the start, both chambers at a pressure."""
        self.driving_pa = self.braking_pa = pressure_pa
        self.piston_m = self.piston_m_s = self.stay_m = self.stay_m_s = self.load_n = 0.0


def slid(speed_m_s: float, force_n: float, resist_n: float, step_s: float, mass_kg: float) -> float:
    """Return the speed after a step under a force and a resistance that only ever opposes."""
    driven_m_s = speed_m_s + step_s * force_n / mass_kg
    stopped_m_s = step_s * resist_n / mass_kg
    if driven_m_s > stopped_m_s:
        return driven_m_s - stopped_m_s
    return driven_m_s + stopped_m_s if driven_m_s < -stopped_m_s else 0.0


@dataclass(slots=True)
class Valve:
    """An on/off valve with delays; a command taken back before it has acted never acts."""

    open_s: float
    close_s: float
    is_open: bool = False
    wanted: bool = False
    due_s: float = 0.0

    def command(self, at_s: float, on: bool) -> None:
        """Take a command that arrives at a time."""
        if on != self.wanted:
            self.wanted = on
            self.due_s = at_s + (self.open_s if on else self.close_s)

    def close(self) -> None:
        """Be closed, with no command to come."""
        self.is_open = self.wanted = False
        self.due_s = 0.0

    def at(self, time_s: float) -> bool:
        """Return whether the valve is open; times may not go back."""
        if self.wanted != self.is_open and time_s >= self.due_s - 1e-9:
            self.is_open = self.wanted
        return self.is_open


class LightModel:
    """Equations of the engagement, one semi-implicit Euler step at a time: 80 arithmetic operations, 2 square roots.

    P' = (alpha_m R f - alpha P V') / V, f = C P_up sqrt(1 - ((r - b)/(1 - b))^2), r = max(P_down/P_up, b); m_p u' =
    A_p (P_d - P_n) - friction for the piston, m_s v' = A_s (P_d - P_atm) - friction - load for the stay, and equal
    speeds where the one pushes the other.
    """

    def __init__(self, settings: ModelSettings, stroke_m: float) -> None:
        self.settings = settings
        self.stroke_m = stroke_m

    def _flow(self, pressure_pa: float, is_open: bool) -> float:
        """Return the flow into a chamber times its exponent, kg K/s; negative when it vents."""
        settings = self.settings
        if is_open:
            upstream_pa, downstream_pa = settings.supply_pa, pressure_pa
            critical = settings.flow_in_critical
            size = settings.filling_alpha_flow * settings.flow_in
        else:
            upstream_pa, downstream_pa = pressure_pa, settings.atmosphere_pa
            critical = settings.flow_out_critical
            size = -settings.venting_alpha_flow * settings.flow_out
        ratio = downstream_pa / upstream_pa
        if ratio >= 1.0:
            return 0.0
        share = (ratio - critical) / (1.0 - critical) if ratio > critical else 0.0
        return size * upstream_pa * sqrt(1.0 - share * share)

    def step(self, motion: LightModelState, driving: bool, braking: bool, step_s: float) -> None:
        """Advance a state by one step with the valves as given; the piston pushes the stay and cannot pull it."""
        settings = self.settings
        piston_kg, stay_kg = settings.piston_kg, settings.stay_kg
        piston_m2, stay_m2 = settings.piston_m2, settings.stay_m2
        z_m, x_m = motion.piston_m, motion.stay_m
        u_m_s, v_m_s = motion.piston_m_s, motion.stay_m_s
        drive_n = piston_m2 * (motion.driving_pa - motion.braking_pa)
        resist_n = settings.piston_friction_n + settings.piston_damping_n_s_m * abs(u_m_s)
        u_m_s = slid(u_m_s, drive_n, resist_n, step_s, piston_kg)
        drive_n = stay_m2 * (motion.driving_pa - settings.atmosphere_pa)
        resist_n = (
            settings.stay_friction_n + motion.load_n + settings.stay_damping_n_s_m * abs(v_m_s)
        )
        v_m_s = slid(v_m_s, drive_n, resist_n, step_s, stay_kg)
        if u_m_s > v_m_s and z_m + step_s * u_m_s > settings.gap_m + x_m + step_s * v_m_s:
            total_kg = piston_kg + stay_kg
            common_m_s = (piston_kg * u_m_s + stay_kg * v_m_s) / total_kg
            if v_m_s <= 0.0:  # the piston's push has the stay's resistance to overcome first
                resist_n = settings.stay_friction_n + motion.load_n
                stopped_m_s = step_s * max(0.0, resist_n - drive_n) / total_kg
                common_m_s = max(0.0, common_m_s - stopped_m_s)
            u_m_s = v_m_s = common_m_s
        new_x_m = min(max(x_m + step_s * v_m_s, 0.0), self.stroke_m)
        new_z_m = min(max(z_m + step_s * u_m_s, 0.0), settings.gap_m + new_x_m)
        way_m = new_z_m - z_m
        driving_m3 = settings.driving_m3 + piston_m2 * z_m + stay_m2 * x_m
        braking_m3 = settings.braking_m3 - piston_m2 * z_m
        swept_m3 = piston_m2 * way_m + stay_m2 * (new_x_m - x_m)
        gain = 287.0 * step_s  # specific gas constant of air, J/(kg K)
        volume = settings.filling_alpha_volume if driving else settings.venting_alpha_volume
        motion.driving_pa += (
            gain * self._flow(motion.driving_pa, driving) - volume * motion.driving_pa * swept_m3
        ) / driving_m3
        volume = settings.filling_alpha_volume if braking else settings.venting_alpha_volume
        motion.braking_pa += (
            gain * self._flow(motion.braking_pa, braking)
            + volume * motion.braking_pa * piston_m2 * way_m
        ) / braking_m3
        if new_x_m >= self.stroke_m or new_x_m <= 0.0:
            v_m_s = 0.0
        if new_z_m <= 0.0 or new_z_m >= settings.gap_m + self.stroke_m:
            u_m_s = 0.0
        motion.piston_m, motion.stay_m = new_z_m, new_x_m
        motion.piston_m_s, motion.stay_m_s = u_m_s, v_m_s


STEP_S = 0.0005
"""Step of the light model."""


class ObserverSettings(Settings, frozen=True):
    """How strongly the model follows the measurements."""

    sensor_age_s: Annotated[float, bounded(0.0, 0.05, "s")] = 0.00455
    """Age of the newest sample at a step, without the filter (pulse, capture, bus, waiting)."""
    position_gain: Annotated[float, bounded(0.0, 2.0, "")] = 0.5
    speed_gain_per_s: Annotated[float, bounded(0.0, 1000.0, "1/s")] = 20.0
    load_gain_n_m: Annotated[float, bounded(0.0, 1e6, "N/m")] = 3e4
    most_load_n: Annotated[float, bounded(0.0, 5000.0, "N")] = 2200.0


class Observer:
    """The light model run in parallel with the actuator and corrected by late measurements.

    Its past position goes through the sensor's filter, so that the difference is what the model does not know; it
    moves position, speed and load. Bounded work: period/0.5 ms model steps and one filter step a sample.
    """

    def __init__(
        self, config: ControlConfig, model: ModelSettings, settings: ObserverSettings
    ) -> None:
        self._settings = settings
        self.model = LightModel(model, config.windows.stroke_m)
        self._past = round(settings.sensor_age_s / STEP_S)
        self.motion = LightModelState(model.atmosphere_pa, model.atmosphere_pa)
        self.driving = Valve(model.valve_open_s, model.valve_close_s)
        self.braking = Valve(model.valve_open_s, model.valve_close_s)
        self._ring = [0.0] * (self._past + 1)
        self._filter = position_filter(config)
        self.reset()

    def reset(self) -> None:
        """Start in neutral, at rest, both chambers vented, valves closed."""
        self.motion.rest(self.model.settings.atmosphere_pa)
        self.driving.close()
        self.braking.close()
        self.steps = 0  # of the model, since the push began
        self._ring[:] = [0.0] * len(self._ring)
        if self._filter is not None:
            self._filter.settle(0.0)

    @property
    def time_s(self) -> float:
        """Time since the push began up to which the model has run."""
        return self.steps * STEP_S

    @property
    def travelled_m(self) -> float:
        """Estimated position of the stay now, m from neutral."""
        return self.motion.stay_m

    def advance(self, until_s: float, measured_m: float, new_samples: int) -> None:
        """Run the model up to now and correct it with a measured position, if it is new."""
        goal = round(until_s / STEP_S)
        while self.steps < goal:
            now_s = self.time_s
            self.model.step(self.motion, self.driving.at(now_s), self.braking.at(now_s), STEP_S)
            self.steps += 1
            self._ring[self.steps % len(self._ring)] = self.travelled_m
        if new_samples:
            self._correct(measured_m, new_samples)

    def _correct(self, measured_m: float, new_samples: int) -> None:
        expected_m = self._ring[(self.steps - self._past) % len(self._ring)]
        if self._filter is not None:
            sampled_m = expected_m
            for _ in range(new_samples):
                expected_m = self._filter.update(sampled_m)
        settings, motion = self._settings, self.motion
        error_m = measured_m - expected_m
        touching = motion.piston_m >= self.model.settings.gap_m + motion.stay_m - 1e-9
        if not touching and motion.stay_m <= 0.0 and error_m <= 1e-4:  # two ticks of the sensor
            return  # the piston moves alone, the stay rests: nothing to correct
        stroke_m = self.model.stroke_m
        moved_m = motion.stay_m + settings.position_gain * error_m
        motion.stay_m = min(max(moved_m, 0.0), stroke_m)
        limit_m = self.model.settings.gap_m + motion.stay_m
        motion.piston_m = limit_m if touching else min(motion.piston_m, limit_m)
        motion.stay_m_s += settings.speed_gain_per_s * error_m
        if touching:
            motion.piston_m_s = motion.stay_m_s
        motion.load_n = min(
            max(motion.load_n - settings.load_gain_n_m * error_m, 0.0), settings.most_load_n
        )

    def command(self, charge: bool, brake: bool) -> None:
        """Note the command of this step."""
        at_s = self.time_s + self.model.settings.transport_s
        self.driving.command(at_s, charge)
        self.braking.command(at_s, brake)
