"""What a truck's bus shows of causes, by tests/reference: differences, Fisher information, pair distances.

Nothing of the product is used. Priors, noise and the rule of an alarm are those that the documentation
of `opc4 diagnose LOG` states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, log

import numpy as np
from scipy.optimize import minimize

from tests.reference import parts
from tests.reference.truck import PERIOD_S, Drive, Pushed, Truck, moved

Floats = np.ndarray

QUIET = {f"repeatability.{name}": 0.0 for name in ("friction_sd", "valve_delay_sd", "supply_sd")}
"""Numbers of a truck whose shifts do not scatter."""
MESH_N, PULL_N = 600.0, 300.0
CONE_N_S_RAD = 0.25 / 0.09
BEFORE_S, AFTER_S = 0.05, 0.27
"""Pulses of a shift: from so long before its first command to so long after its last."""
SHAKEN_S, JITTER_S, SPEED_RAD_S = 2e-7, 5e-5, 0.1
"""Noise of a pulse's length, of its instant, and of a speed difference: one standard deviation."""
INSTANT_S, MOVING_M_S = (5e-4, 2e-3), 0.1
"""How far the instants of a shift scatter, at least and at most, seen where the stay moves."""
TAIL = 6.0
"""Degrees of freedom of the priors of the truck's own quantities."""
SIZE_SD = 3.0
NOTICED_SIZES = 0.05 * 1.15 ** np.arange(50.0)
DIFFER = 9.0
"""Chi squared by which two causes differ that can be separated."""
LARGEST = 10.0


@dataclass(frozen=True)
class Setting:
    """What is changed of the truck: numbers and changes of tests/reference, loads, what is reported."""

    values: dict[str, float] = field(default_factory=dict)
    change: dict[str, float] = field(default_factory=dict)
    mesh_n: float = 0.0
    pull_n: float = 0.0
    cone: dict[str, float] = field(default_factory=dict)
    late_s: float = 0.0
    offset_m: float = 0.0
    gain: float = 0.0
    warmer_k: float = 0.0


UNCHANGED = Setting()


@dataclass(frozen=True)
class Cause:
    """A cause of one size: its change by size in typical ones, and which sizes are physical.

    key: of tests/reference; typical: per size, or the factor of one size if `scales`. step: of the
    difference, in typical sizes.
    """

    name: str
    key: str
    typical: float
    low: float = 0.0
    high: float = inf
    scales: bool = False
    step: float = 1.0
    central: bool = False

    def setting(self, size: float) -> Setting:
        """Return the change at a size in typical ones."""
        amount = self.typical**size if self.scales else self.typical * size
        if self.name == "hose_droop":
            return Setting(change={"line_cda_m2": 4.0 * self.typical / size, "line_m3": 5e-5})
        if self.key in ("late_s", "gain", "warmer_k"):
            return Setting(**{self.key: amount})
        width = {"detent_m": 0.002} if self.key == "detent_n" else {}
        return Setting(change={self.key: amount} | width)


CAUSES = (
    Cause("dynamic_friction", "running", 1.5, scales=True),
    Cause("static_friction", "static", 1.5, scales=True),
    Cause("friction_asymmetry", "one_way", 0.3, -3.1, 3.1, central=True),
    Cause("seal_pressure_friction", "seal", 0.05),
    Cause("piston_leak", "piston_leak_m2", 2e-7),
    Cause("leak_to_atmosphere", "leak_out_m2", 2e-7),
    Cause("supply_low", "supply", -0.05),
    Cause("hose_droop", "line_cda_m2", 5e-6),
    Cause("valve_open_delay", "open_later_s", 0.003),
    Cause("valve_slow_close", "close_later_s", 0.010),
    Cause("exhaust_clog", "outlet", 1.2, -inf, 0.0, scales=True, step=-1.0),
    Cause("inlet_clog", "inlet", 1.2, -inf, 0.0, scales=True, step=-1.0),
    Cause("free_play", "free_travel_m", 0.001, -12.0, 20.0),
    Cause("stop_wear", "stop_m", 0.0003, -16.0, 16.0),
    Cause("external_force", "force_n", 50.0, -40.0, 40.0, central=True),
    Cause("detent", "detent_n", 100.0),
    Cause("sensor_temperature", "warmer_k", 20.0, -7.5, 7.5, central=True),
    Cause("sensor_gain", "gain", 0.05, -10.0, 10.0, central=True),
    Cause("sensor_delay", "late_s", 0.005),
    Cause("added_mass", "mass_kg", 0.5),
)
"""Those that tests/reference can hide in a truck, with the catalogue's typical sizes."""


def priors() -> dict[str, float]:
    """Return the standard deviation of every quantity in which healthy trucks differ."""
    own = parts.nominal()
    sd = {
        name: float(own[f"repeatability.unit_{name}_sd"]) for name in ("friction", "flow", "volume")
    }
    delay = float(own["repeatability.unit_valve_delay_sd"])
    return {
        "friction": sd["friction"], "rise": delay, "fall": 3.0 * delay, "flow_in": sd["flow"],
        "flow_out": sd["flow"], "volume_a": sd["volume"], "volume_b": sd["volume"], "supply": 0.03,
        "linkage": 0.3, "mass": 0.2, "mesh": 300.0, "pull": 400.0, "cone_B": 0.3, "cone_F": 0.3,
        "latency": 3e-4, "offset": 1e-4, "gain": 0.005,
    }  # fmt: skip


def moved_to(name: str, amount: float) -> Setting:
    """Return the setting with one quantity in which trucks differ at an amount, in its unit."""
    shares = {"friction": "friction", "flow_in": "inlet", "flow_out": "outlet"}
    amounts = {
        "rise": "open_later_s", "fall": "close_later_s", "volume_a": "outer_volume",
        "volume_b": "inner_volume", "supply": "supply",
    }  # fmt: skip
    if name in shares:
        return Setting(change={shares[name]: 1.0 + amount})
    if name in amounts:
        return Setting(change={amounts[name]: amount})
    if name.startswith("cone"):
        return Setting(cone={name[-1]: 1.0 + amount})
    numbers = {"linkage": "truck.F_gearbox", "mass": "truck.m_gearbox"}
    if name in numbers:
        return Setting(
            values={numbers[name]: float(parts.nominal()[numbers[name]]) * (1.0 + amount)}
        )
    own = {"mesh": "mesh_n", "pull": "pull_n", "latency": "late_s", "offset": "offset_m"}
    return Setting(**{own.get(name, name): amount})


def quiet_truck(setting: Setting = UNCHANGED, phase_s: float = 0.0) -> Truck:
    """Return the nominal truck with equal loads and without scatter, changed."""
    whole = {"friction": 1.0, "open_later_s": 0.0, "close_later_s": 0.0} | setting.change
    mesh, pull = MESH_N + setting.mesh_n, PULL_N + setting.pull_n
    return Truck(
        QUIET | setting.values, whole, float(parts.nominal()["supply.P_s"]), CONE_N_S_RAD, phase_s,
        mesh_n=(mesh, mesh), pull_n=(pull, pull),
    )  # fmt: skip


@dataclass(frozen=True)
class Pulses:
    """Noise-free pulses of one shift: instants from the command on, positions, speeds; each [n].

    grid_s, path_m: the motion between them.
    """

    pushed: Pushed
    time_s: Floats
    position_m: Floats
    speed_m_s: Floats
    grid_s: Floats
    path_m: Floats

    def kink_m2(self, instant_s: float) -> Floats:
        """Return the variance [n] that scattered instants add beyond what the speed says."""
        off, share = np.polynomial.hermite_e.hermegauss(9)
        variance = np.zeros(len(self.time_s))
        for by, weight in zip(instant_s * off, share / share.sum(), strict=True):
            there = np.interp(self.time_s + by, self.grid_s, self.path_m)
            beyond = np.abs(there - self.position_m) - np.abs(by * self.speed_m_s)
            variance += weight * np.maximum(beyond, 0.0) ** 2
        return variance


def instants(pushed: Pushed, phase_s: float) -> Floats:
    """Return when a shift's pulses measure [n], in s from its first command on."""
    first = np.ceil((pushed.begin_s - BEFORE_S - phase_s) / PERIOD_S)
    count = np.floor((pushed.off_s + AFTER_S - phase_s) / PERIOD_S) - first
    starts = phase_s + PERIOD_S * (first + np.arange(count))
    return starts + 0.5 * float(parts.nominal()["position_sensor.t_mid"]) - pushed.begin_s


def motion(pushed: Pushed, setting: Setting) -> tuple[Floats, Floats]:
    """Return times from the command on and positions of a shift of a changed truck, without noise.

    Raises StalledError if it does not arrive.
    """
    impulse = pushed.impulse_n_s * setting.cone.get(pushed.kind[-1], 1.0)
    grid, x, _spent = moved(quiet_truck(setting), pushed.kind, impulse, np.random.default_rng(0))
    return grid, x


def reported(pushed: Pushed, times: Floats, setting: Setting) -> Floats:
    """Return the positions [n] that pulses at instants [n] report without noise, of one shift.

    Raises StalledError if the changed truck does not arrive.
    """
    position = np.interp(times - setting.late_s, *motion(pushed, setting))
    own = parts.nominal()
    middle_m = own["position_sensor.t_mid"] / own["position_sensor.slope"]
    warm = own["position_sensor.temp_coeff"] * setting.warmer_k
    shown = position * (1.0 + setting.gain) + setting.offset_m
    return np.asarray(shown + warm * (shown + middle_m))


def measured(driven: Drive, phase_s: float) -> list[Pulses]:
    """Return the noise-free pulses of the unchanged truck's shifts."""
    found = []
    for pushed in driven.shifts:
        times, (grid, x) = instants(pushed, phase_s), motion(pushed, UNCHANGED)
        early, at, late = (np.interp(times + by, grid, x) for by in (-1e-4, 0.0, 1e-4))
        found.append(Pulses(pushed, times, at, (late - early) / 2e-4, grid, x))
    return found


def slopes(pulses: Pulses, step: float = 0.1) -> tuple[Floats, Floats]:
    """Return slopes [n, 17] by prior deviations and [n, causes] by typical sizes, in m.

    step: of the differences of the truck's own quantities; those are central.
    """
    times, pushed = pulses.time_s, pulses.pushed
    own, causes = [], []
    for name, sd in priors().items():
        far, back = (reported(pushed, times, moved_to(name, s * step * sd)) for s in (1.0, -1.0))
        own.append((far - back) / (2.0 * step))
    for cause in CAUSES:
        by = step * cause.step
        far, back = reported(pushed, times, cause.setting(by)), pulses.position_m
        if cause.central:
            back, by = reported(pushed, times, cause.setting(-by)), 2.0 * by
        causes.append((far - back) / by)
    return np.stack(own, 1), np.stack(causes, 1)


def noise_covariance(pulses: Pulses, own: Floats) -> Floats:
    """Return the covariance [n, n] in m^2 of a shift's pulses; own: slopes [n, 17] by deviations."""
    values, sd = parts.nominal(), priors()
    tick = values["position_sensor.timer_resolution"] / np.sqrt(12.0)
    pulse_m = np.hypot(tick, SHAKEN_S) / values["position_sensor.slope"]
    scatter = {
        "friction": values["repeatability.friction_sd"],
        "rise": values["repeatability.valve_delay_sd"],
        "fall": values["repeatability.valve_delay_sd"],
        "supply": 0.01,
        "latency": 1e-4,
    }
    if (end := pulses.pushed.kind[-1]) != "N":
        known = SPEED_RAD_S / abs(pulses.pushed.difference_rad_s)
        scatter[f"cone_{end}"] = float(np.hypot(0.04, known))
    names = list(sd)
    spread = np.stack([own[:, names.index(key)] * by / sd[key] for key, by in scatter.items()], 1)
    speed = np.abs(pulses.speed_m_s)
    fast = speed > MOVING_M_S
    instant = np.max(np.sqrt(np.sum(spread[fast] ** 2, axis=1)) / speed[fast], initial=0.0)
    alone = pulse_m**2 + (JITTER_S * speed) ** 2
    alone += pulses.kink_m2(float(np.clip(instant, *INSTANT_S)))
    return np.diag(alone) + spread @ spread.T


@dataclass(frozen=True)
class Shown:
    """Information of all shifts: own [17, 17], across [causes, 17], between causes [causes, causes]."""

    own: Floats
    across: Floats
    causes: Floats

    def projected(self) -> Floats:
        """Return the information [causes, causes] with the truck's own quantities marginalised."""
        prior = (TAIL + 1.0) / TAIL * np.eye(len(self.own))
        return self.causes - self.across @ np.linalg.solve(self.own + prior, self.across.T)

    def hidden(self, k: int, size: float, near: Floats) -> tuple[float, Floats]:
        """Return what a cause costs a truck called healthy, and the own quantities [17] that hide it.

        near: those at another size; priors with heavy tails have several minima.
        """
        cross, alone = self.across[k], float(self.causes[k, k])

        def cost(u: Floats) -> tuple[float, Floats]:
            """Return half chi squared and minus the log prior, with its slope [17]."""
            value = 0.5 * size**2 * alone - size * cross @ u + 0.5 * u @ self.own @ u
            value += 0.5 * (TAIL + 1.0) * np.sum(np.log1p(u**2 / TAIL))
            return value, self.own @ u - size * cross + (TAIL + 1.0) * u / (TAIL + u**2)

        usual = np.zeros(len(cross))
        free = np.linalg.solve(self.own + 1e-3 * np.eye(len(cross)), size * cross)
        prior = np.linalg.solve(self.own + np.eye(len(cross)), size * cross)
        starts = (usual, free, prior, near)
        found = (minimize(cost, start, jac=True, method="BFGS") for start in starts)
        best = min(found, key=lambda item: float(item.fun))
        return float(best.fun), np.asarray(best.x)

    def deviation(self, k: int, size: float, u: Floats) -> float:
        """Return the standard deviation of `hidden`, over noise and usual trucks: by its slopes."""
        cross = self.across[k]
        left = size**2 * self.causes[k, k] - 2.0 * size * cross @ u + u @ self.own @ u
        pull = (TAIL + 1.0) * u / (TAIL + u**2)
        return float(np.sqrt(max(left, 0.0) + pull @ pull))

    def noticed(self) -> Floats:
        """Return the smallest size [causes] of each that gives an alarm in 9 of 10 trucks, or NaN."""
        found = np.full(len(CAUSES), np.nan)
        information = np.diag(self.projected())
        for k, cause in enumerate(CAUSES):
            volume = 0.5 * np.log1p(SIZE_SD**2 * information[k])
            near = np.zeros(len(self.own))
            for size in NOTICED_SIZES:
                gain, near = self.hidden(k, size, near)
                needed = log(99.0 * len(CAUSES)) + volume + 0.5 * (size / SIZE_SD) ** 2
                if gain - 1.28 * self.deviation(k, size, near) > needed:
                    found[k] = size if size <= max(cause.high, -cause.low) else np.nan
                    break
        return found


def information(all_pulses: Sequence[Pulses]) -> Shown:
    """Return the information of shifts, by differences of simulated positions."""
    own, across, causes = 0.0, 0.0, 0.0
    for pulses in all_pulses:
        a, c = slopes(pulses)
        weight = np.linalg.inv(noise_covariance(pulses, a))
        own, across, causes = (
            own + a.T @ weight @ a,
            across + c.T @ weight @ a,
            causes + c.T @ weight @ c,
        )
    return Shown(np.asarray(own), np.asarray(across), np.asarray(causes))


def apart(found: Floats, sizes: Floats) -> Floats:
    """Return how far [causes, causes] a cause (row) of its size is from the best size of another.

    found: projected information. sizes: [causes], NaN gives NaN. In chi squared.
    """
    far = np.full(found.shape, np.nan)
    for k, one in enumerate(CAUSES):
        size = max(sizes[k], 1.0) if sizes[k] > 0.0 else np.nan
        signs = [s for s in (1.0, -1.0) if (one.high if s > 0.0 else -one.low) > 0.0]
        for j, other in enumerate(CAUSES):
            tried = np.linspace(max(other.low, -LARGEST), min(other.high, LARGEST), 4001)
            for sign in signs:
                a = sign * size
                d = a * a * found[k, k] - 2.0 * a * tried * found[k, j] + tried**2 * found[j, j]
                far[k, j] = np.fmin(far[k, j], d.min())
    return far
