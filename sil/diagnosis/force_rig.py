"""Other actuators, known by driving force and position: what acts on the body.

The hypotheses of `force_fit` go through the verdict of all rigs. What no cause explains is described
by functions without a form: of speed, position, pressure, direction. Whether the record is sound,
signs and time base agree and the motion is informative is judged first.

Source: inverse dynamic identification, e.g. Gautier, Janot, Vandanjon 2013.
Checked by: tests/unit/sil/diagnosis/test_force_rig.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sil.campaign.campaign import Floats
from sil.diagnosis.force_fit import (
    SURE,
    Bank,
    Group,
    Tried,
    gain_in_errors,
)
from sil.diagnosis.force_gas import enclosed_gas
from sil.diagnosis.force_record import Recorded, read_motion
from sil.diagnosis.force_result import DESCRIBED, ForceDiagnosis
from sil.diagnosis.force_terms import CONDITIONS, difference
from sil.diagnosis.verdict import UNNAMED, Verdict, decide, weigh
from sil.fitting.floor import EXPLAINED

LEAST_SHARE = 0.5
"""Causes next to a residual explain at least this share of the plain body's misfit."""
LONGEST_DELAY_S = 0.5
DELAY_LEAVES = 0.3
"""A delay is reported if it leaves less than this share of all that is not explained without it."""
GIVING_BACK = ("position", "pressure_gain", "pressure times position")
"""Forces that do no work on the whole when a motion returns."""
ALIKE = 2.0
"""A cause keeps its value within this factor, whatever describes the residual, in each half of the samples."""
CONTAINED = 0.5
"""A function contains a cause if less than this share of the cause differs from it."""
LEAST_OF_EXCESS = 0.5
"""A cause explains at least this share of the misfit that is there without it ..."""
LEAST_OF_LATE = 0.2
"""... and a delay within a sampling step this share."""
HELD = 0.1
"""This near to half a step early, in steps, the force is held from sample to sample."""


def diagnose_force(path: str | Path) -> ForceDiagnosis:
    """Diagnose a campaign with rig = "force".

    Raises InputError as `read_motion` does.
    """
    return diagnose_motion(read_motion(path))


def diagnose_motion(record: Recorded) -> ForceDiagnosis:
    """Diagnose a motion that was read."""
    bank, tried = _tried(record)
    judged, verdict = _decided(bank, tried)
    late_s = _late_within_a_step_s(bank, min(tried, key=lambda item: item.rms_n), verdict.leader)
    if late_s:
        record = _sooner(record, late_s)
        bank, tried = _tried(record)
        judged, verdict = _decided(bank, tried)
    plain = tried[0]
    singles = [item for item in tried if len(item.groups) == 1]
    smooth = bank.add_smooth()
    doubts = (*record.doubts, *_doubts(bank, plain))
    rest = ("", "", 0.0)
    robust: tuple[str, ...] = ()
    leader = verdict.leader
    doubts = tuple(filter(None, (*doubts, enclosed_gas(bank, leader))))
    if leader.whole.beyond > 0.0:
        rest = _described(bank, leader, smooth)
        if 1.0 - leader.whole.excess / plain.whole.excess >= LEAST_SHARE:
            named = [group for group in leader.groups if group.id != UNNAMED]
            robust = tuple(group.id for group in named if _is_robust(bank, leader, group))
    return ForceDiagnosis(record, bank, plain, verdict, judged, singles, doubts, rest, robust)


def _tried(record: Recorded) -> tuple[Bank, list[Tried]]:
    bank = Bank(record)
    tried = [bank.attempt(())] if bank.is_constant() else bank.all_tried()
    bank.calibrate(tried)
    return bank, tried


def _decided(bank: Bank, tried: Sequence[Tried]) -> tuple[list[Tried], Verdict[Tried]]:
    """Return the hypotheses that are physical, best first, and the verdict on them."""
    by_names = {frozenset(item.names): item for item in tried}
    judged = [item for item in tried if _acceptable(item, by_names)]
    judged.sort(key=lambda item: item.score)
    while True:
        weigh(judged)
        verdict = decide(judged, len(tried[0].squares))
        if all(_has_one_value(bank, verdict.leader, group) for group in verdict.leader.groups):
            return judged, verdict
        judged.remove(verdict.leader)


def _has_one_value(bank: Bank, item: Tried, group: Group) -> bool:
    """Return whether a cause has the same value in both halves of the samples, by each condition.

    A term that only makes up for one that is missing has another value where that acts more. Halves
    that determine the value poorly contradict nothing.
    """
    if group.id == UNNAMED:
        return True
    k = bank.own(item.groups).index(group.columns[0])
    for condition in CONDITIONS.values():
        values = condition(bank.record.raw)[bank.record.judged]
        middle = np.median(values)
        for rows in (values < middle, values >= middle):
            own, deviations = bank.fitted_on(item.groups, rows)
            ratio, error = own[k] / item.values[k], 2.0 * deviations[k] / abs(item.values[k])
            if ratio + error < 1.0 / ALIKE or ratio - error > ALIKE:
                return False
    return True


def _late_within_a_step_s(bank: Bank, best: Tried, leader: Tried) -> float:
    """Return by how much the force is late against the position [s], 0 unless that explains a residual.

    A command that is held from sample to sample acts half a step after it is recorded. The delay is
    what `best` leaves of it, which may be all that is left of the leader's residual.
    """
    if leader.rms_n <= EXPLAINED * leader.noise_n:
        return 0.0
    ratio = best.rms_n / best.noise_n
    record = bank.record
    base = np.linalg.qr(bank.columns[:, bank.own(best.groups)])[0]
    rate = record.filtered(record.raw.force_n, 1)[record.judged]
    rest, moved = (values - base @ (base.T @ values) for values in (bank.target, rate))
    late_s = -float(rest @ moved / (moved @ moved))
    error_s = float(np.sqrt(rest @ rest / (moved @ moved) / best.count))
    left = ratio**2 * float(np.mean((rest + late_s * moved) ** 2) / np.mean(rest**2))
    explains = left - 1.0 < (1.0 - LEAST_OF_LATE) * (ratio**2 - 1.0)
    if not explains or not SURE * error_s < abs(late_s) <= record.step_s:
        return 0.0
    half_s = 0.5 * record.step_s
    return -half_s if abs(late_s + half_s) < HELD * record.step_s else late_s


def _sooner(record: Recorded, late_s: float) -> Recorded:
    """Return a record with its driving force taken so much earlier, and a finding that says so.

    A pressure that the force comes from is moved with it. What is held over a step h acts as
    F(t - h/2) + h^2/24 F'', to the next order in h: its mean over the step.
    """
    from scipy.ndimage import correlate1d, shift

    held = 1.0 / 24.0 if late_s == -0.5 * record.step_s else 0.0

    def moved(values: Floats) -> Floats:
        parts = np.split(values, record.starts[1:])
        parts = [shift(p, -late_s / record.step_s, mode="nearest") for p in parts]
        mean = (held, 1.0 - 2.0 * held, held)
        return np.concatenate([correlate1d(p, mean, mode="nearest") for p in parts])

    pressure = record.raw.pressure_pa
    if pressure is not None and (record.body.piston_area_m2 or record.body.area_2_m2):
        pressure = moved(pressure)
    text = (
        f"the driving force is {abs(late_s):.3g} s {'late' if late_s > 0 else 'early'} against the "
        "position, within a sampling step (a command that is held from sample to sample?): taken off"
    )
    raw = replace(record.raw, force_n=moved(record.raw.force_n), pressure_pa=pressure)
    return replace(record, raw=raw, findings=(*record.findings, text))


def _acceptable(item: Tried, by_names: dict[frozenset[str], Tried]) -> bool:
    """Return whether a hypothesis is physical and gains by each of its causes."""
    if not item.groups:
        return True
    if not item.physical():
        return False
    for name in item.names:
        without = by_names[frozenset(item.names) - {name}]
        if gain_in_errors(item, without) < SURE:
            return False
        if without.groups and without.rms_n <= EXPLAINED * without.noise_n:
            return False  # nothing is missing: the cause corrects the form of the other one
        if item.whole.excess > (1.0 - LEAST_OF_EXCESS) * max(without.whole.excess, 0.0):
            return False
    return True


def _described(bank: Bank, leader: Tried, smooth: Sequence[Group]) -> tuple[str, str, float]:
    """Return what the leader's residual depends on, its class, and the share of its squares."""
    found = []
    for group in smooth:
        item = bank.attempt((*leader.groups, group))
        share = 1.0 - item.rms_n**2 / leader.rms_n**2
        found.append((group.name, group.cause_class, share))
    name, cause_class, share = max(found, key=lambda entry: entry[2])
    return name, cause_class if share >= DESCRIBED else "mechanics", share


def _is_robust(bank: Bank, leader: Tried, group: Group) -> bool:
    """Return whether a cause comes out alike whatever else describes the residual.

    Descriptions that contain the cause are put in its place: one of another class must not leave less
    than those of its own class do.
    """
    k = bank.own(leader.groups).index(group.columns[0])
    thin = slice(None, None, max(1, len(bank.target) // 5000))
    own = bank.columns[thin, group.columns[0]]
    others = tuple(item for item in leader.groups if item is not group)
    own_class, foreign = [leader], list[Tried]()
    for other in bank.groups:
        if other.name in {g.name for g in leader.groups}:
            continue
        described = bank.columns[thin][:, bank.own([other])]
        if difference(np.linalg.qr(described)[0], own) < CONTAINED:
            alike = other.cause_class == group.cause_class
            (own_class if alike else foreign).append(bank.attempt((*others, other)))
            continue
        item = bank.attempt((*leader.groups, other))
        ratio = item.values[k] / leader.values[k]
        if not 1.0 / ALIKE < ratio < ALIKE or abs(item.values[k]) < 2.0 * item.deviations[k]:
            return False
    best = min(own_class, key=lambda item: item.rms_n)
    return all(gain_in_errors(item, best) < SURE for item in foreign)


# --- what forbids a conclusion ----------------------------------------------------------------
def _doubts(bank: Bank, plain: Tried) -> list[str]:
    """Return why nothing can be concluded from this record, none usually."""
    found = []
    delay = _delay_s(bank, plain)
    if delay:
        found.append(
            f"the driving force is {abs(delay):.3g} s {'late' if delay > 0 else 'early'} against the "
            f"position: correct the time base, or state delay_s = {delay:.4g} for it in [columns]"
        )
    # forces that a motion to and fro gives back must not be taken for friction
    giving_back = [g for g in bank.groups if g.name in GIVING_BACK]
    now, without = (_friction(bank, groups) for groups in ([], giving_back))
    if now and without and not delay:
        found.append(now)
    if "offset_n" not in bank.body:
        found.append(f"offset_n: {bank.missing.pop('offset_n')}")
    if "stiffness" in bank.missing and "mass_kg" in bank.body and plain.value("mass_kg")[0] == 0.0:
        found.append(
            "mass and stiffness move together: motion at another frequency would separate them"
        )
    rms = float(np.sqrt(np.mean(bank.target**2)))
    if rms < SURE * plain.noise_n or bank.is_constant():
        found.append(
            "the driving force is constant, or hardly exceeds its noise: larger or faster strokes would help"
        )
    return found


def _friction(bank: Bank, groups: Sequence[Group]) -> str:
    """Return what is not physical about friction and mass without bounds; empty if nothing is.

    A reversed sign reverses both: with a mass that is surely positive, other forces act.
    """
    speed = np.abs(bank.record.raw.speed_m_s[bank.record.judged])
    size = {"coulomb_n": float(np.mean(speed)), "viscous_n_s_m": float(np.mean(speed**2))}
    (power, spread), (mass, mass_spread) = (
        bank.free_combination(np.array([weights.get(name, 0.0) for name in bank.body]), groups)
        for weights in (size, {"mass_kg": 1.0})
    )
    drives, negative = power < -2.0 * spread, mass < -2.0 * mass_spread
    if not drives and not (negative and power < 2.0 * spread):
        return ""
    kg = bank.record.units.get("kg", "kg")
    if drives and mass > 2.0 * mass_spread:
        return (
            f"friction would drive the body ({-power:.3g} W), with a mass of {mass:.3g} {kg}: other forces "
            "act on it (pressure, gravity, a drive that is not recorded?), or the driving force is not all of it"
        )
    odd = [f"friction would drive the body ({-power:.3g} W)"] if drives else []
    odd += [f"the mass would be {mass:.3g} {kg}"] if negative else []
    return (
        f"{' and '.join(odd)}: the sign of the driving force or of the position is reversed "
        "(state scale = -1), or other forces act"
    )


def _delay_s(bank: Bank, plain: Tried) -> float:
    """Return by how much the force lags behind the position [s], 0 if nothing speaks for a delay.

    The force is moved against all columns at once, so that no cause is taken for a delay.
    """
    record = bank.record
    if plain.rms_n <= 3.0 * plain.noise_n:
        return 0.0
    most = min(int(LONGEST_DELAY_S / record.step_s), len(record.judged) // 8)
    lags = np.unique(np.r_[-most : most + 1 : max(1, most // 250), -8:9])
    rows = np.flatnonzero(record.judged)
    inside = (rows >= most) & (rows < len(record.judged) - most)
    picked = np.flatnonzero(inside)[:: max(1, len(rows) // 5000)]
    q = np.linalg.qr(bank.columns[picked])[0]
    force = record.filtered(record.raw.force_n)
    if record.body.mass_kg is not None:
        force = force - record.body.mass_kg * record.raw.acceleration_m_s2
    moved = force[rows[picked][:, None] + lags]
    left = np.sum(moved**2, axis=0) - np.sum((q.T @ moved) ** 2, axis=0)
    left /= np.sum((moved - moved.mean(axis=0)) ** 2, axis=0)
    best = int(np.argmin(left))
    if left[best] > DELAY_LEAVES * left[lags == 0][0]:
        return 0.0
    return float(lags[best] * record.step_s)
