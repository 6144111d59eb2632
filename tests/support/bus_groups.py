"""Which causes a truck's bus cannot separate: by Fisher information of tests/reference, and as diagnosed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from plant.parameters import load
from sil.shift_diagnosis.healthy import rest_noise_m
from sil.shift_diagnosis.linear import Noise, linearise, projected
from sil.shift_diagnosis.model import PlantModel, catalogue
from sil.shift_diagnosis.shifts import shifts_of
from sil.shift_diagnosis.verdict import Detectable, detectable_of, distances
from tests.reference.truck import Drive, drive, write_drive
from tests.support import bus_information as theory
from tests.support.bus_information import CAUSES, DIFFER, Floats

PHASE_S = 0.0037
CLOSE = 0.8
"""Correlation of what two causes do from which they are listed."""
NAMES = [cause.name for cause in CAUSES]
VARIANTS = {"hose_droop": "hose_droop:5e-05"}
"""Of a cause with several variants, the one that tests/reference has; else the first."""


@dataclass(frozen=True)
class Sides:
    """Information between causes [causes, causes] by theory and by the diagnosis, and what it says.

    sizes: smallest noticed by theory [causes], in typical ones, NaN at none. detectable: of the
    diagnosis. far: how far a cause of its size (row) is from another, by theory, in chi squared.
    """

    theory: Floats
    diagnosed: Floats
    sizes: Floats
    detectable: tuple[Detectable, ...]
    far: Floats

    def groups(self, k: int) -> tuple[list[str], list[str]]:
        """Return the ids that look like a cause by theory, and by the diagnosis."""
        own = [name for name, d in zip(NAMES, self.far[k], strict=True) if d < DIFFER]
        return [name for name in own if name != NAMES[k]], list(self.detectable[k].alike)


def driven(shifts: int = 8, seed: int = 5) -> Drive:
    """Drive the nominal truck with equal loads and without scatter."""
    return drive(theory.quiet_truck(phase_s=PHASE_S), shifts, np.random.default_rng(seed))


def diagnosed(own: Drive, seed: int = 9) -> tuple[Floats, tuple[Detectable, ...]]:
    """Return the diagnosis's information [causes, causes] and what it says of the drive's log."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "quiet.log"
        truck = theory.quiet_truck(phase_s=PHASE_S)
        write_drive(path, truck, own, np.random.default_rng(seed))
        shifts = list(shifts_of(str(path), load("nominal"), None, Counter()))
    known = {cause.name: cause for cause in catalogue()}
    causes = [known[VARIANTS.get(name, name)] for name in NAMES]
    model = PlantModel(load("nominal"), mounted=True)
    linear = linearise(model, shifts, np.zeros(17), causes, noise=Noise(rest_noise_m(shifts)))
    return projected(linear.without_cliffs())[0], detectable_of(linear, len(causes))


def compared(own: Drive) -> Sides:
    """Return what both sides say of the shifts of a drive."""
    shown = theory.information(theory.measured(own, PHASE_S))
    found, sizes = shown.projected(), shown.noticed()
    information, detectable = diagnosed(own)
    return Sides(found, information, sizes, detectable, theory.apart(found, sizes))


def correlation(information: Floats) -> Floats:
    """Return the correlations [causes, causes] of what causes do, with the truck's own taken out."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    return np.asarray(information / np.outer(scale, scale))


def far_by_diagnosis(sides: Sides) -> Floats:
    """Return the distances [causes, causes] of the diagnosis, at the sizes of the theory."""
    causes = [item.cause for item in sides.detectable]
    rows = []
    for k, size in enumerate(sides.sizes):
        tested = max(size, 1.0) * (causes[k].sign or 1)
        row = distances(sides.diagnosed, causes, k, tested)
        rows.append(np.where(np.isnan(size), np.nan, row))
    return np.array(rows)


def lines(sides: Sides) -> Iterator[str]:
    """Yield the tables of both sides."""
    yield "| cause | shown by one typical size, sd: theory, diagnosis | noticed from, typical sizes | alike by theory | by the diagnosis |"
    yield "|---|---|---|---|---|"
    for k, name in enumerate(NAMES):
        sd = [f"{np.sqrt(side[k, k]):.2f}" for side in (sides.theory, sides.diagnosed)]
        sizes = [sides.sizes[k], abs(sides.detectable[k].size or np.nan)]
        noticed = ["none" if np.isnan(size) else f"{size:.2g}" for size in sizes]
        groups = [", ".join(group) or "-" for group in sides.groups(k)]
        yield f"| {name} | {', '.join(sd)} | {', '.join(noticed)} | {groups[0]} | {groups[1]} |"
    shown = [k for k in range(len(NAMES)) if sides.sizes[k] > 0.0 and sides.detectable[k].size]
    differ = []
    for k in shown:
        one, other = map(set, sides.groups(k))
        differ += [f"{NAMES[k]} and {name}" for name in sorted(one ^ other)]
    pairs = len(shown) * (len(NAMES) - 1)
    yield f"noticed by both: {len(shown)} causes; pairs on which they agree: {pairs - len(differ)}/{pairs}"
    yield f"pairs on which they do not: {'; '.join(differ) or 'none'}"
    yield from _same_size(sides)


def _same_size(sides: Sides) -> Iterator[str]:
    """Yield how far pairs are apart at the same sizes, and the correlations of all pairs."""
    far, other = sides.far, far_by_diagnosis(sides)
    used = np.isfinite(far) & np.isfinite(other) & ~np.eye(len(NAMES), dtype=bool)
    same = (far < DIFFER) == (other < DIFFER)
    yield f"at the sizes of the theory: {int((same & used).sum())}/{int(used.sum())} pairs agree"
    ratio = np.sqrt(other[used] / np.maximum(far[used], 1e-9))
    quarters = np.percentile(ratio, (5, 50, 95))
    yield "distance by diagnosis over theory, 5, 50, 95 %: " + ", ".join(
        f"{q:.2f}" for q in quarters
    )
    for k, j in np.argwhere(used & (~same | (far < DIFFER) | (other < DIFFER))):
        by = f"{np.sqrt(far[k, j]):.1f}, {np.sqrt(other[k, j]):.1f} sd"
        yield f"  {NAMES[k]} ({max(sides.sizes[k], 1.0):.2g} typical) from {NAMES[j]}: {by}"
    pairs = [(k, j) for k, j in np.argwhere(np.triu(np.ones(far.shape), 1)) if _acts(sides, k, j)]
    r, s = (correlation(side) for side in (sides.theory, sides.diagnosed))
    off = np.sqrt(np.mean([(r[pair] - s[pair]) ** 2 for pair in pairs]))
    yield f"correlations of {len(pairs)} pairs: rms difference {off:.2f}; above {CLOSE}, theory, diagnosis:"
    for k, j in pairs:
        if max(abs(r[k, j]), abs(s[k, j])) > CLOSE:
            yield f"  {NAMES[k]}, {NAMES[j]}: {r[k, j]:+.2f}, {s[k, j]:+.2f}"


def _acts(sides: Sides, k: int, j: int) -> bool:
    """Return whether two causes do anything in these shifts."""
    return bool(min(sides.theory[k, k], sides.theory[j, j]) > 1e-9)


def measure() -> Iterator[str]:
    """Compare both sides on 8 shifts of the nominal truck."""
    yield from lines(compared(driven()))
