"""Other actuators, known by driving force and position: what acts on the body.

The hypotheses of `force_fit` go through the verdict of all rigs. What no cause explains is described
by functions without a form: of speed, position, pressure, direction. Whether the record is sound,
signs and time base agree and the motion is informative is judged first.

Source: inverse dynamic identification, e.g. Gautier, Janot, Vandanjon 2013.
Checked by: tests/unit/sil/inference/force/test_rig.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sil.inference.force.delay import without_delay
from sil.inference.force.fit import Bank, ForceFit, TermGroup, gain_in_errors, jackknife
from sil.inference.force.record import Recorded
from sil.inference.force.result import ForceDiagnosis
from sil.inference.force.terms import difference
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.verdict import decide


def diagnose_motion(record: Recorded) -> ForceDiagnosis:
    """Diagnose a motion that was read."""
    choice, taken_off, delay = without_delay(record)
    findings = (*record.findings, *filter(None, [taken_off]))
    record = replace(choice.bank.record, findings=findings)
    bank, plain, leader = choice.bank, choice.tried[0], choice.leader
    singles = [item for item in choice.tried if len(item.groups) == 1]
    smooth = bank.add_smooth()
    doubts = (*record.doubts, *_doubts(bank, plain, delay))
    rest = ("", "", 0.0)
    verdict = choice.verdict
    if leader.whole.beyond > 0.0:
        rest = _described(bank, leader, smooth)
        named = [group for group in leader.groups if group.id != UNNAMED]
        leader.is_robust = bool(named) and all(_is_robust(bank, leader, g) for g in named)
        verdict = decide(choice.judged, len(plain.squares))
    return ForceDiagnosis(record, bank, plain, verdict, choice.judged, singles, doubts, rest)


def _described(bank: Bank, leader: ForceFit, smooth: Sequence[TermGroup]) -> tuple[str, str, float]:
    """Return what the leader's residual depends on, its class, and the share of its squares."""
    descriptions = []
    for group in smooth:
        item = bank.attempt((*leader.groups, group))
        share = 1.0 - item.rms_n**2 / leader.rms_n**2
        descriptions.append((group.name, group.cause_class, share))
    name, cause_class, share = max(descriptions, key=lambda entry: entry[2])
    return name, cause_class if share >= LIMITS.min_described_share else "mechanics", share


def _is_robust(bank: Bank, leader: ForceFit, group: TermGroup) -> bool:
    """Return whether a cause comes out alike whatever else describes the residual.

    Descriptions that contain the cause are put in its place: one of another class must not leave less
    than those of its own class do.
    """
    thin = slice(None, None, max(1, len(bank.target) // 5000))
    cause_column = bank.columns[thin, group.columns[0]]
    others = tuple(item for item in leader.groups if item is not group)
    own_class, foreign = [leader], list[ForceFit]()
    for other in bank.groups:
        if other.name in leader.names:
            continue
        described = bank.columns[thin][:, bank.columns_of([other])]
        if difference(np.linalg.qr(described)[0], cause_column) < 0.5:
            alike = other.cause_class == group.cause_class
            (own_class if alike else foreign).append(bank.attempt((*others, other)))
            continue
        item = bank.attempt((*leader.groups, other))
        value, deviation = item.size_of(group)
        ratio, most = value / leader.size_of(group)[0], LIMITS.max_value_ratio
        if not 1.0 / most < ratio < most or abs(value) < 2.0 * deviation:
            return False
    best = min(own_class, key=lambda item: item.rms_n)
    return all(gain_in_errors(item, best) < LIMITS.min_standard_errors for item in foreign)


# --- what forbids a conclusion ----------------------------------------------------------------
def _doubts(bank: Bank, plain: ForceFit, delay: str) -> list[str]:
    """Return why nothing can be concluded from this record, none usually: a delay, and more."""
    doubts = [delay] if delay else []
    # forces that do no work on the whole when a motion returns must not be taken for friction
    conservative = ("position", "pressure_gain", "pressure times position")
    giving_back = [group for group in bank.groups if group.name in conservative]
    now, without = (_friction(bank, groups) for groups in ([], giving_back))
    if now and without and not delay:
        doubts.append(now)
    if "offset_n" not in bank.body:
        doubts.append(f"offset_n: {bank.missing.pop('offset_n')}")
    if "stiffness" in bank.missing and "mass_kg" in bank.body and plain.value("mass_kg")[0] == 0.0:
        doubts.append(
            "mass and stiffness move together: motion at another frequency would separate them"
        )
    rms = float(np.sqrt(np.mean(bank.target**2)))
    if rms < LIMITS.min_standard_errors * plain.noise_n or bank.is_constant():
        doubts.append(
            "the driving force is constant, or hardly exceeds its noise: larger or faster strokes would help"
        )
    return doubts


def _friction(bank: Bank, groups: Sequence[TermGroup]) -> str:
    """Return what is not physical about friction and mass without bounds; empty if nothing is.

    A reversed sign reverses both: with a mass that is surely positive, other forces act.
    """
    speed = np.abs(bank.record.raw.speed_m_s[bank.record.judged])
    size = {"coulomb_n": float(np.mean(speed)), "viscous_n_s_m": float(np.mean(speed**2))}
    values, without = bank.unbounded(groups)

    def combined(weights: dict[str, float]) -> tuple[float, float]:
        shares = np.array([weights.get(name, 0.0) for name in bank.body])
        parts, errors = values[: len(shares)], (without - values)[:, : len(shares)]
        return float(shares @ parts), float(jackknife(errors @ shares))

    (power, spread), (mass, mass_spread) = combined(size), combined({"mass_kg": 1.0})
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
