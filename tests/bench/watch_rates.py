"""`opc4 watch` on drawn per-shift observations: false alarms in 1e5 shifts, dates of steps and drifts."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import numpy as np

import sil.shift_diagnosis.track as tracking
from sil.shift_diagnosis.track import Track

PARAMETERS = 12


def observed(
    generator: np.random.Generator, sizes: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information [n, p, p] and score [n, p] of shifts whose sizes [n, p] are true."""
    n, p = sizes.shape
    root = np.linalg.cholesky(information)
    score = sizes @ information + generator.normal(size=(n, p)) @ root.T
    return np.broadcast_to(information, (n, p, p)), score


def information_of(generator: np.random.Generator, p: int = PARAMETERS) -> np.ndarray:
    """Return the information of one shift about p sizes, correlated, as that of a truck is."""
    mixed = generator.normal(size=(p, p)) + 1.5 * generator.normal(size=(p, 1))
    return np.asarray(mixed @ mixed.T / p + 0.05 * np.eye(p))


def watched(sizes: np.ndarray, seed: int, at_once: int = 500) -> Track:
    """Return the track of a truck whose sizes [n, p] are these."""
    generator = np.random.default_rng(seed)
    information = information_of(generator, sizes.shape[1])
    track = Track.of(tuple(f"p{k}" for k in range(sizes.shape[1])))
    for begin in range(0, len(sizes), at_once):
        h, z = observed(generator, sizes[begin : begin + at_once], information)
        track.take(h, z, np.arange(begin, begin + len(z)) * 60.0)
    return track


def measure(trucks: int = 100, shifts: int = 20_000) -> Iterator[str]:
    """Yield false alarms of steady trucks by threshold, then dates of steps and drifts."""
    stated = tracking.THRESHOLD
    for threshold in (4.6, 5.0, stated):
        tracking.THRESHOLD = threshold
        began = perf_counter()
        alarms = sum(
            len(watched(np.zeros((shifts, PARAMETERS)), seed).changes) for seed in range(trucks)
        )
        rate = alarms / (trucks * shifts) * 1e5
        yield (
            f"threshold {threshold}: {alarms} false alarms in {trucks * shifts:.0e} shifts, {rate:.2f} in 1e5; "
            f"{1e6 * (perf_counter() - began) / trucks / shifts:.0f} us a shift"
        )
    tracking.THRESHOLD = stated
    yield from _dated(trucks, shifts)


def _dated(trucks: int, shifts: int) -> Iterator[str]:
    for kind in ("step", "drift"):
        errors: list[float] = []
        right, count = 0, 0
        for seed in range(trucks):
            generator = np.random.default_rng([seed, 5])
            at, k = int(generator.uniform(0.2, 0.8) * shifts), int(generator.integers(PARAMETERS))
            sizes = np.zeros((shifts, PARAMETERS))
            amount = float(generator.uniform(0.3, 1.5))
            rest = np.arange(shifts - at)
            sizes[at:, k] = amount if kind == "step" else amount * rest / 4000.0
            found = watched(sizes, seed).changes
            count += len(found)
            hit = next((c for c in found if c.name == f"p{k}" or f"p{k}" in c.alike), None)
            if hit is not None:
                right += hit.kind == kind
                errors.append(abs(hit.shift - at))
        far = np.quantile(errors, [0.5, 0.95]) if errors else (np.nan, np.nan)
        yield (
            f"{kind}: {len(errors)} of {trucks} found, {right} as such, {count} changes in all; date off by {far[0]:.0f} "
            f"shifts (median), {far[1]:.0f} (95 %)"
        )
