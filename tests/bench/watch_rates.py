"""`opc4 watch` on drawn per-shift observations: false alarms in 1e5 shifts, dates of steps and drifts."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from time import process_time

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


def watched(sizes: np.ndarray, seed: int, of_trip: int = 0, between: float = 0.0) -> Track:
    """Return the track of a truck whose sizes [n, p] are these.

    of_trip: mean number of shifts of a trip; 0: all are one. between: standard deviation of the
    sizes between trips, by that of a shift.
    """
    generator = np.random.default_rng(seed)
    information = information_of(generator, sizes.shape[1])
    own = np.diag(information) ** -0.5
    track = Track.of(tuple(f"p{k}" for k in range(sizes.shape[1])))
    begin, time_s = 0, 0.0
    while begin < len(sizes):
        n = 500 if not of_trip else 1 + int(generator.exponential(of_trip))
        here = sizes[begin : begin + n]
        if between:
            here = here + between * own * generator.normal(size=len(own))
        h, z = observed(generator, here, information)
        track.take(h, z, time_s + np.arange(len(z)) * 60.0)
        begin, time_s = begin + n, time_s + len(z) * 60.0 + (1e4 if of_trip else 0.0)
    return track


RATES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Borders of the classes of drifts, in standard deviations of a shift in 1000 shifts."""
STEPS = (0.3, 0.5, 1.0, 2.0)
"""Borders of the classes of steps, in standard deviations of a shift."""


TRIPS = (8, 1.0), (60, 0.0), (60, 0.2), (60, 1.0), (300, 1.0)
"""Mean number of shifts of a trip, and by how much trips differ, in standard deviations of a shift."""


def measure(trucks: int = 100, shifts: int = 20_000) -> Iterator[str]:
    """Yield false alarms of steady trucks by threshold, then dates of steps and drifts."""
    stated = tracking.THRESHOLD
    for threshold in (5.0, stated):
        tracking.THRESHOLD = threshold
        began = process_time()
        alarms = sum(
            len(watched(np.zeros((shifts, PARAMETERS)), seed).changes) for seed in range(trucks)
        )
        rate = alarms / (trucks * shifts) * 1e5
        yield (
            f"threshold {threshold}: {alarms} false alarms in {trucks * shifts:.0e} shifts, {rate:.2f} in 1e5; "
            f"{1e6 * (process_time() - began) / trucks / shifts:.0f} us of a processor a shift"
        )
    tracking.THRESHOLD = stated
    for of_trip, between in TRIPS:
        steady = np.zeros((shifts, PARAMETERS))
        count = trucks // 4
        alarms = sum(len(watched(steady, seed, of_trip, between).changes) for seed in range(count))
        yield (
            f"trips of {of_trip} shifts in the mean that differ by {between:g} standard deviations of a shift: "
            f"{alarms} false alarms in {count * shifts:.0e} shifts"
        )
    yield "| change | size | trucks | found | as such | within 200 shifts | error 50 %, 95 % | in its interval | interval 50 % | changes |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for kind, borders in (("step", STEPS), ("drift", RATES)):
        for number, (low, high) in enumerate(pairwise(borders)):
            seeds = range(1000 * number, 1000 * number + trucks // (len(borders) - 1))
            yield _dated(kind, low, high, seeds, shifts)


def _dated(kind: str, low: float, high: float, seeds: range, shifts: int) -> str:
    """Return the row of trucks with one change whose size is between two borders."""
    rows, count = [], 0
    for seed in seeds:
        generator = np.random.default_rng([seed, 5])
        at, k = int(generator.uniform(0.2, 0.8) * shifts), int(generator.integers(PARAMETERS))
        own = information_of(np.random.default_rng(seed))[k, k] ** -0.5
        amount = float(np.exp(generator.uniform(np.log(low), np.log(high)))) * own
        sizes = np.zeros((shifts, PARAMETERS))
        sizes[at:, k] = amount * (1.0 if kind == "step" else np.arange(shifts - at) / 1000.0)
        found = watched(sizes, seed).changes
        count += len(found)
        hit = next((c for c in found if c.name == f"p{k}" or f"p{k}" in c.alike), None)
        if hit is not None:
            error = abs(hit.shift - at)
            rows.append((hit.kind == kind, error, hit.low <= at <= hit.high, hit.high - hit.low))
    right, error, held, width = np.array(rows, dtype=float).T
    half, most = np.quantile(error, [0.5, 0.95])
    return (
        f"| {kind} | {low:g} to {high:g} | {len(seeds)} | {len(rows)} | {right.sum():.0f} | "
        f"{(error <= 200).sum()} | {half:.0f}, {most:.0f} | {held.sum():.0f} | {np.median(width):.0f} | {count} |"
    )
