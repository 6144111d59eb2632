"""Plain bodies whose force is held from sample to sample, without a controller, exact between samples."""

from __future__ import annotations

from math import exp, inf, log
from pathlib import Path

import numpy as np

STROKES = 8
SHAPES = ("steps", "sines", "alternating")
TURNS = 10
"""Most turns within a sampling step."""


def held_force(shape: str, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a force [n] of the size of 1 at the instants t [n] in s."""
    if shape == "steps":
        levels, durations = rng.normal(0.0, 1.5, 200), rng.uniform(0.02, 0.3, 200)
        return np.asarray(levels[np.searchsorted(np.cumsum(durations), t)])
    if shape == "sines":
        waves = np.outer(t, rng.uniform(4.0, 40.0, 4)) + rng.uniform(0.0, 2.0 * np.pi, 4)
        return np.asarray(1.2 * np.sin(waves).sum(axis=1))
    period = rng.uniform(0.1, 0.5)
    return 1.5 * np.sign(np.sin(2.0 * np.pi * t / period + 0.3)) * (1.0 + 0.3 * np.sin(t))


def position_m(force_n: np.ndarray, step_s: float, body: dict[str, float]) -> np.ndarray:
    """Return the position [n] of a body from rest under a force [n] that each step holds."""
    mass, coulomb = body["mass_kg"], body["coulomb_n"]
    rate = body["viscous_n_s_m"] / mass
    x, v, found = 0.0, 0.0, np.empty(len(force_n))
    for k, held in enumerate(force_n):
        found[k] = x
        left, net = step_s, float(held) - body["offset_n"]
        for _ in range(TURNS):
            if v == 0.0 and abs(net) <= coulomb:
                break
            sign = np.sign(v) if v else np.sign(net)
            final = (net - coulomb * sign) / mass / rate
            turn = log((v - final) / -final) / rate if v * final < 0.0 else inf
            time = min(left, turn)
            share = 1.0 - exp(-rate * time)
            x += final * time + (v - final) * share / rate
            v = 0.0 if turn <= left else v + (final - v) * share
            left -= time
            if left <= 0.0:
                break
    return found


def draw_held(folder: Path, seed: int, uneven: float = 1.0) -> dict[str, float]:
    """Write a campaign of one body, noise up to `uneven` times in each file; return what is true."""
    rng = np.random.default_rng([seed, 98])
    rate = float(rng.choice([250.0, 500.0, 1000.0]))
    mass = 10.0 ** rng.uniform(-0.3, 2.0)
    size = mass * 10.0 ** rng.uniform(-0.5, 1.0)
    body = {
        "mass_kg": mass,
        "coulomb_n": size * rng.uniform(0.05, 0.6),
        "viscous_n_s_m": mass / rng.uniform(0.1, 1.0),
        "offset_n": size * rng.uniform(-0.1, 0.1),
    }
    noise, fine = 10.0 ** rng.uniform(-2.7, -1.5) * size, 10.0 ** rng.uniform(-5.0, -4.0)
    folder.mkdir(parents=True)
    lines = ['name = "body"', 'rig = "force"', f"sample_rate_hz = {rate}"]
    step_m = 0.0
    more = uneven ** np.random.default_rng([seed, 99]).random(STROKES)
    for number in range(STROKES):
        t = np.arange(int(rng.uniform(2.0, 4.0) * rate)) / rate
        force = size * held_force(SHAPES[seed % len(SHAPES)], t, rng)
        x = position_m(force, 1.0 / rate, body)
        step_m = step_m or fine * float(np.ptp(x))
        x = np.round((x + more[number] * rng.normal(0.0, step_m, len(t))) / step_m) * step_m
        force = force + more[number] * rng.normal(0.0, noise, len(t))
        force = np.round(force / (0.5 * noise)) * (0.5 * noise)
        file, header = f"{number}.csv", "time_s,position_m,force_n"
        np.savetxt(
            folder / file, np.column_stack([t, x, force]), "%.9g", ",", header=header, comments=""
        )
        lines.append(f'[[stroke]]\nfile = "{file}"')
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return body | {"noise_n": noise}
