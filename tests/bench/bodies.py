"""Bodies of which force and position are known, drawn at random, and how they are judged.

Integrated by scipy's LSODA under a controller that follows a reference, or (held, and uneven: noise that differs
between files) exactly from sample to sample: nothing of the engine that judges them. `python -m tests.bench bodies` prints a table; $OPC4_FIRST (0) is the first number drawn from.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from math import cos, sin
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from can_dbc.errors import InputError
from tests.support.force_rig import diagnose_force
from tests.support.held_bodies import draw_held

KINDS = {
    "plain": 60,
    "held": 50,
    "uneven": 50,
    "k_p": 25,
    "stribeck": 20,
    "asymmetry": 20,
    "stiffness": 20,
    "flexible": 15,
    "area": 10,
    "reversed": 15,
    "corrupted": 15,
}
EXPECTED = {
    "k_p": "seal_pressure_friction",
    "stribeck": "stribeck",
    "asymmetry": "friction_asymmetry",
    "stiffness": "stiffness",
}
CORRUPTIONS = ("spikes", "stuck", "shift", "nan", "jump")

HEAD = """name = "body"
rig = "force"
sample_rate_hz = {rate}
[body]
piston_area_m2 = {area}
[[stroke]]
file = "a.csv"
"""


def reference(
    rng: np.random.Generator, span_s: float, travel_m: float, w: np.ndarray
) -> Callable[[float], tuple[float, float, float]]:
    """Motion as position, speed and acceleration by time: sines of w [3] in rad/s, a sweep over two, or moves of least jerk."""
    sizes = travel_m * np.array([0.6, 0.3, 0.15]) * rng.uniform(0.5, 1.0, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    levels = travel_m * rng.uniform(-0.8, 0.8, int(span_s * w[1]) + 2)
    lasting_s, grows = 2.0 * np.pi / w[1], (w[1] - w[0]) / span_s

    def sines(s: float) -> tuple[float, float, float]:
        a, b = sizes * np.sin(w * s + phases), sizes * w * np.cos(w * s + phases)
        return float(a.sum()), float(b.sum()), float(-(w**2) @ a)

    def sweep(s: float) -> tuple[float, float, float]:
        angle, rate = w[0] * s + 0.5 * grows * s**2, w[0] + grows * s
        x, v = 0.7 * travel_m * sin(angle), 0.7 * travel_m * cos(angle)
        return x, v * rate, v * grows - x * rate**2

    def moves(s: float) -> tuple[float, float, float]:
        number, into = divmod(max(s, 0.0), lasting_s)
        low, high = levels[int(number) : int(number) + 2]
        u, d = min(1.3 * into / lasting_s, 1.0), 1.3 / lasting_s
        x = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        v, a = 30.0 * (u * (1.0 - u)) ** 2, 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u)
        return low + (high - low) * x, (high - low) * v * d, (high - low) * a * d**2

    return (sines, sweep, moves)[rng.integers(3)]


def draw(folder: Path, kind: str, seed: int) -> dict[str, float]:
    """Write a campaign of one body of this kind; return what is true of it."""
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([100.0, 250.0, 500.0, 1000.0, 2000.0]))
    t = np.arange(int(rng.uniform(12.0, 25.0) * max(1.0, 250.0 / rate) * rate)) / rate
    if rng.random() < 0.3:  # a clock that is not even
        t[1:] += rng.uniform(-0.3, 0.3, len(t) - 1) / rate
    mass = 10.0 ** rng.uniform(-0.3, 2.0)
    travel = 10.0 ** rng.uniform(-2.0, -0.5)
    w = rng.uniform(2.0, 8.0) * np.array([1.0, 2.3, 3.9])
    path = reference(rng, t[-1], travel, w)
    _, fast, fastest = np.max(np.abs([path(s) for s in np.linspace(0.0, t[-1], 4000)]), axis=0)
    inertia = mass * fastest
    coulomb = inertia * rng.uniform(0.05, 0.8)
    viscous = inertia * rng.uniform(0.05, 0.8) / fast
    offset = inertia * rng.uniform(-0.3, 0.3)
    slow = 0.002 * fast
    amount = rng.uniform(0.3, 1.0)
    extra = {
        "per_pa": amount * coulomb / 4e5 if kind == "k_p" else 0.0,
        "stribeck_n": amount * coulomb if kind == "stribeck" else 0.0,
        "uneven": rng.choice([-1.0, 1.0]) * 0.5 * amount if kind == "asymmetry" else 0.0,
        "stiffness": 2.0 * amount * inertia / travel if kind == "stiffness" else 0.0,
        "area_slope": 0.3 * amount / travel if kind == "area" else 0.0,
    }
    pressured = kind in ("k_p", "area") or rng.random() < 0.4
    levels = rng.uniform(1e5, 8e5, 12)
    area = inertia / 4e5 if pressured else 0.0

    def pressure(s: float) -> float:
        return float(np.interp(s, np.linspace(0.0, t[-1], 12), levels))

    def resistance(s: float, x: float, v: float) -> float:
        sign = np.tanh(v / slow)
        force = coulomb * sign + viscous * v + offset + extra["stiffness"] * x
        force += extra["per_pa"] * pressure(s) * sign
        force += extra["stribeck_n"] * sign * np.exp(-abs(v) / (0.15 * fast))
        force += extra["uneven"] * (coulomb * abs(sign) + viscous * abs(v))
        return float(force - area * extra["area_slope"] * x * pressure(s))

    stiff = mass * 40.0**2
    load = 0.5 * mass if kind == "flexible" else 0.0
    joint = load * (rng.uniform(2.0, 5.0) * w[2]) ** 2

    def drive(s: float, x: float, v: float) -> float:
        rx, rv, ra = path(s)
        force = mass * ra + stiff * (rx - x) + 2.0 * mass * 40.0 * (rv - v) + coulomb * np.sign(rv)
        return float(force)

    def rates(s: float, y: np.ndarray) -> list[float]:
        x, v, x2, v2 = y
        pull = joint * (x - x2) + 0.02 * (joint * load) ** 0.5 * (v - v2)
        own = mass - load
        return [
            v,
            (drive(s, x, v) - resistance(s, x, v) - (pull if load else 0.0)) / own,
            v2,
            pull / load if load else 0.0,
        ]

    x0, v0, _ = path(0.0)
    y = solve_ivp(
        rates, (0.0, t[-1]), [x0, v0, x0, v0], "LSODA", t, rtol=1e-8, atol=1e-10, max_step=0.01
    ).y
    x = y[0]
    f = np.array([drive(s, a, b) for s, a, b in zip(t, y[0], y[1], strict=True)])
    p = np.array([pressure(s) for s in t])
    noise = 10.0 ** rng.uniform(-2.7, -1.5) * float(np.std(f))
    f = f - area * p + rng.normal(0.0, noise, len(t))
    x = x + rng.normal(0.0, 10.0 ** rng.uniform(-5.0, -4.0) * travel, len(t))
    if kind == "reversed":
        if pressured or rng.random() < 0.5:
            x = -x
        else:
            f = -f
    if kind == "corrupted":
        f, x = corrupt(rng, CORRUPTIONS[seed % len(CORRUPTIONS)], f, x, rate)
    columns = [t, x, f] + ([p + rng.normal(0.0, 500.0, len(t))] if pressured else [])
    folder.mkdir(parents=True)
    header = "time_s,position_m,force_n" + (",pressure_pa" if pressured else "")
    np.savetxt(folder / "a.csv", np.column_stack(columns), "%.9g", ",", header=header, comments="")
    (folder / "campaign.toml").write_text(HEAD.format(rate=rate, area=area), encoding="utf-8")
    return {"mass_kg": mass, "coulomb_n": coulomb, "viscous_n_s_m": viscous, "noise_n": noise}


def corrupt(
    rng: np.random.Generator, how: str, f: np.ndarray, x: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return force and position with one thing wrong."""
    f, x = f.copy(), x.copy()
    where = int(rng.integers(len(f) // 4, len(f) // 2))
    if how == "spikes":
        f[rng.integers(0, len(f), 12)] += 8.0 * np.std(f)
    elif how == "stuck":
        f[where : where + int(rate)] = f[where]
    elif how == "shift":
        f = np.roll(f, int(0.2 * rate))
    elif how == "nan":
        f[where] = np.nan
    else:
        x[where:] += 0.5 * np.ptp(x)
    return f, x


def judge(folder: Path, kind: str, seed: int) -> tuple[str, list[str], float, float, float]:
    """Return verdict, causes, largest probability, residual over noise, and the noise over the true."""
    if kind in ("held", "uneven"):
        true = draw_held(folder, seed, uneven=5.0 if kind == "uneven" else 1.0)
    else:
        true = draw(folder, kind, seed)
    try:
        found = diagnose_force(folder)
    except InputError as error:
        return "refused", [str(error).partition(": ")[2]], 0.0, 0.0, 1.0
    result = found.as_json()
    numbers = [v["value"] for v in result["body"].values()]
    assert np.all(np.isfinite(numbers)), "NaN"
    causes = [cause["id"] for cause in result["causes"]]
    if result["verdict"] == "cannot_tell":
        causes = [result["findings"][0][:60]]
    surest = max((cause["probability"] for cause in result["causes"]), default=0.0)
    return result["verdict"], causes, surest, found.leader.over_noise, true["noise_n"]


def is_right(kind: str, verdict: str, causes: list[str]) -> bool:
    """Return whether a verdict is what a careful engineer would say."""
    if kind in ("plain", "held", "uneven"):
        return verdict == "consistent"
    if kind in EXPECTED:
        return verdict in ("named", "ambiguous") and EXPECTED[kind] in causes
    if kind in ("flexible", "area"):
        return verdict in ("unnamed", "ambiguous") and "unnamed" in causes
    return verdict in ("cannot_tell", "refused")


def measure(count: int = 300) -> Iterator[str]:
    """Lines: what is not right as it comes, then a table by kind."""
    total: Counter[tuple[str, str]] = Counter()
    right: Counter[str] = Counter()
    alarms = unexplained = 0
    first = int(os.environ.get("OPC4_FIRST", "0"))
    with tempfile.TemporaryDirectory() as name:
        for kind, share in KINDS.items():
            for seed in range(first, first + max(1, share * count // 300)):
                answer = judge(Path(name) / f"{kind}{seed}", kind, seed)
                good = is_right(kind, *answer[:2])
                total[kind, answer[0]] += 1
                right[kind] += good
                alarms += kind in ("plain", "held", "uneven") and not good
                unexplained += answer[0] == "consistent" and answer[3] > 3.0
                if not good:
                    yield f"not right: {kind} {seed}: {answer}"
    yield "kind          right  verdicts"
    for kind in KINDS:
        verdicts = {v: n for (k, v), n in sorted(total.items()) if k == kind}
        yield f"{kind:12s} {right[kind]:3d} of {sum(verdicts.values()):3d}  {verdicts}"
    yield f"false alarms {alarms}, consistent with more than 3 times the noise {unexplained}"
