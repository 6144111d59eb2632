"""The diagnosis of a body known by driving force and position: what acts on it, and whether the record can say so.

The hypotheses of `fit` go through the verdict of all rigs. What no cause explains is described by
functions without a form. Signs, time base and how much the motion tells are judged first.

Source: inverse dynamic identification, e.g. Gautier, Janot, Vandanjon 2013.
Checked by: tests/unit/sil/inference/force/test_diagnosis.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sil.inference.force.delay import without_delay
from sil.inference.force.fit import (
    VISCOUS,
    Bank,
    ForceFit,
    TermGroup,
    gain_in_errors,
    jackknife,
)
from sil.inference.force.record import Recorded
from sil.inference.force.terms import difference
from sil.inference.report import (
    Gain,
    Interval,
    ReportedCause,
    diagnosis_json,
    headline,
    seen_sentence,
)
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.verdict import Conclusion, Verdict, decide, kind_of

DETECTABILITY = (
    "with driving force and position alone: causes in the balance of forces; a constant force cannot be "
    "distinguished from Coulomb friction that differs with direction, gauge pressure not from absolute pressure"
)


@dataclass(frozen=True)
class ForceDiagnosis:
    """What was found on a rig known by force and position alone.

    judged: explanations that are physical, the best first; singles: each term alone; doubts: why nothing
    can be concluded; rest: what the leader's residual depends on, its class, the share of its squares.
    """

    record: Recorded
    bank: Bank
    plain: ForceFit
    verdict_: Verdict[ForceFit]
    judged: Sequence[ForceFit]
    singles: Sequence[ForceFit]
    doubts: tuple[str, ...]
    rest: tuple[str, str, float]

    def error(self, item: ForceFit) -> float:
        """Return the relative force error: held-out rms over the rms of the driving force."""
        return item.rms_n / (float(np.sqrt(np.mean(self.bank.target**2))) + 1e-300)

    @property
    def leader(self) -> ForceFit:
        """The hypothesis accepted: the plain body if no cause is."""
        return self.verdict_.leader

    @property
    def unit(self) -> str:
        """Unit of the driving force, or torque."""
        return self._unit("N")

    @property
    def verdict(self) -> str:
        """One of the verdicts of a diagnosis."""
        if self.doubts:
            return kind_of(Conclusion({}, undecidable="; ".join(self.doubts)))
        return self.verdict_.kind

    def _unit(self, unit: str) -> str:
        """Return a unit of the catalogue as this rig has it, which may be rotary."""
        return self.record.units.get(unit, unit)

    def body(self) -> dict[str, Interval]:
        """Return the body's parameters, without a mass that the motion does not determine."""
        parameters = {}
        units = {"coulomb_n": "N", VISCOUS: "N s/m", "offset_n": "N", "mass_kg": "kg"}
        for name in self.leader.body:
            item = Interval.normal(*self.leader.value(name), self._unit(units[name]))
            if name != "mass_kg" or not self._loose_mass():
                low = item.low if name == "offset_n" else max(0.0, item.low)
                parameters[name] = replace(item, low=low)
        return parameters

    def _loose_mass(self) -> str:
        """Return why a mass is not stated, empty if it is determined within a quarter."""
        if "mass_kg" not in self.leader.body:
            return ""
        value, deviation = self.leader.value("mass_kg")
        if 1.96 * deviation <= 0.25 * value:
            return ""
        high = f"{value + 1.96 * deviation:.3g} {self._unit('kg')}"
        return f"not determined, at most {high}: faster strokes would determine it"

    def causes(self) -> list[ReportedCause]:
        """Return the causes claimed and their rivals, and what no named cause explains."""
        causes = []
        for name, probability in self.verdict_.probabilities.items():
            others = [i for i in self.judged if name in i.ids and i.probability > 0.0]
            if name in self.leader.ids:
                causes.append(self._cause(name, self.leader, probability))
            elif others:
                causes.append(self._cause(name, others[0], probability))
            else:
                causes.append(self._unexplained(probability))
        # what the verdict says comes first
        last = UNNAMED if self.verdict in ("named", "ambiguous") else ""
        return sorted(causes, key=lambda cause: (cause.id == last, -cause.probability))

    def _cause(self, name: str, item: ForceFit, probability: float) -> ReportedCause:
        group = item.groups[item.ids.index(name)]
        value, deviation = item.size_of(group)
        assert group.form is not None or name == UNNAMED
        what, parameter, unit = f"a force with the {group.name}", "snap_kg_s2", "kg s^2"
        if group.form is not None:
            what, parameter = group.form.what, group.form.parameter
            unit = self._unit(group.form.unit)
        leading = set(self.leader.ids)
        others = [i for i in self.judged if name not in i.ids and set(i.ids) <= leading]
        without = min(others, key=lambda i: i.score)
        text = (
            f"{what}: {value:.3g} {unit}; with it, the held-out residual falls from "
            f"{without.over_noise:.3g} to {item.over_noise:.3g} times the noise, "
            f"{gain_in_errors(item, without):.1f} standard errors; relative force error "
            f"{self.error(without):.2%} before, {self.error(item):.2%} after"
        )
        if name not in leading:
            text = f"cannot be distinguished from {self.leader.name}: {text}"
        parameters = {parameter: Interval.normal(value, deviation, unit)}
        return ReportedCause(name, group.cause_class, probability, parameters, text, what=what)

    def _unexplained(self, probability: float) -> ReportedCause:
        """Return the cause of a residual that neither noise nor a named cause explains."""
        item, unit = self.leader, self.unit
        counts = np.unique(self.record.raw.block[self.record.judged], return_counts=True)[1]
        blocks = item.squares / counts
        error = 1.96 * float(np.std(blocks, ddof=1) / np.sqrt(len(blocks)))
        mean = item.rms_n**2 - item.noise_n**2
        low, value, high = (max(0.0, mean + e) ** 0.5 for e in (-error, 0.0, error))
        on, cause_class, share = self.rest
        where = f"{on} describes {share:.0%} of it"
        if share < LIMITS.min_described_share:
            where = (
                "no function of speed, position or pressure describes it: dynamic (a flexible joint, a "
                "time lag, vibration) or not repeated from stroke to stroke"
            )
        besides = f"besides {item.name}, " if self.verdict in ("named", "ambiguous") else ""
        text = (
            f"{besides}a force of {value:.3g} {unit} rms that no named cause explains: the held-out residual is "
            f"{item.over_noise:.3g} times the noise of {item.noise_n:.3g} {unit} "
            f"({self.error(item):.1%} of the driving force); {where}"
        )
        what = f"a force of {value:.2g} {unit} rms, {self.error(item):.1%} of the driving force"
        parameters = {"force_rms_n": Interval(value, low, high, unit)}
        return ReportedCause(UNNAMED, cause_class, probability, parameters, text, what=what)

    def refused(self) -> dict[str, str]:
        """Return why terms are not claimed, by name."""
        reasons = dict(self.bank.missing)
        if why := self._loose_mass():
            reasons["mass_kg"] = why
        for item in self.singles:
            if set(item.ids) & set(self.verdict_.probabilities):
                continue
            share, errors = (
                1.0 - item.rms_n**2 / self.plain.rms_n**2,
                gain_in_errors(item, self.plain),
            )
            text = f"removes {share:.1%} of the held-out squares, {errors:.1f} standard errors"
            if not item.physical():
                value, _deviation = item.size_of(item.groups[0])
                text = f"{value:.3g} has a sign that is not physical, or includes zero"
            reasons[item.groups[0].name] = f"not claimed: {text}"
        return reasons

    def findings(self) -> list[str]:
        """Return why nothing can be concluded, what is odd, and why causes are not claimed."""
        refused = [f"{name}: {why}" for name, why in self.refused().items()]
        left = (
            f"the best hypothesis leaves {self.error(self.leader):.1%} of the driving force unexplained, "
            f"{self.leader.over_noise:.3g} times the noise"
        )
        return [*self.doubts, *([left] if self.doubts else []), *self.record.findings, *refused]

    @property
    def gain(self) -> Gain:
        """What the leader explains, on groups of strokes held out."""
        plain, leader = self.plain, self.leader
        channel = "torque_n_m" if self.record.units else "force_n"
        files = (f"every group of {self.record.held_out} in turn",)
        rms = {channel: (plain.rms_n, leader.rms_n, leader.noise_n)}
        return Gain(files, rms, plain.over_noise, leader.over_noise)

    def detectable(self) -> list[dict[str, Any]]:
        """Return the smallest size of each cause that would have gained and removed enough and exceeded its own error."""
        needed = LIMITS.needed_gain(len(self.plain.squares))
        removed = LIMITS.max_removable_share / (1.0 - LIMITS.max_removable_share)
        sizes: dict[str, dict[str, Any]] = {}
        for item in self.singles:
            group = item.groups[0]
            if group.form is None or group.id in (*self.verdict_.claimed, UNNAMED):
                continue
            noise_n = max(item.noise_n, item.expected_n) / self.bank.free_rms(group)
            least = (LIMITS.min_standard_errors + 1.28) * item.size_of(group)[1]
            sizes[group.id] = {
                "id": group.id,
                "parameter": group.form.parameter,
                "size": max(max(2.0 * needed / item.count, removed) ** 0.5 * noise_n, least),
                "unit": self._unit(group.form.unit),
            }
        return list(sizes.values())

    @property
    def headline(self) -> str:
        """The one sentence that a reader needs first."""
        sizes = [(item["id"], item["size"], 0.0, item["unit"]) for item in self.detectable()]
        causes = [] if self.doubts else self.causes()
        return headline(self.verdict, causes, seen_sentence(sizes), "; ".join(self.doubts))

    def as_json(self) -> dict[str, Any]:
        """Return the object that diagnosis.json holds."""
        return diagnosis_json(
            self.record.name,
            self.verdict,
            [] if self.doubts else self.causes(),
            self.findings(),
            f"a cause gains at least 15 and 1.5 a group of strokes in log evidence on held-out strokes, "
            f"{LIMITS.min_standard_errors:g} standard errors over them, and has a physical sign; explained: a residual of at "
            f"most {LIMITS.max_residual_ratio:g} times the noise, of which no cause removes {LIMITS.max_removable_share:.0%}; measured by python -m tests.bench bodies",
            headline=self.headline,
            explains=str(self.gain),
            hypotheses=[
                {"causes": list(ids), "probability": p} for ids, p in self.verdict_.hypotheses
            ],
            rivals=[list(group) for group in self.verdict_.rivals],
            gain=self.gain.as_json(),
            body={name: item.as_json() for name, item in self.body().items()},
            **{"noise_n_m" if self.record.units else "noise_n": self.plain.noise_n},
            unexplained_share=self.error(self.leader),
            detectable=self.detectable(),
            detectability=DETECTABILITY,
        )


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
    rms_n = [bank.attempt((*leader.groups, group)).rms_n for group in smooth]
    best = int(np.argmin(rms_n))
    share = 1.0 - rms_n[best] ** 2 / leader.rms_n**2
    cause_class = smooth[best].cause_class if share >= LIMITS.min_described_share else "mechanics"
    return smooth[best].name, cause_class, share


def _is_robust(bank: Bank, leader: ForceFit, group: TermGroup) -> bool:
    """Return whether a cause comes out alike whatever else describes the residual.

    Where a description contains the cause, one of another class must not leave less than its own class.
    """
    thin = slice(None, None, max(1, len(bank.target) // 5000))
    cause_column = bank.columns[thin, group.columns[0]]
    others = tuple(item for item in leader.groups if item is not group)
    of_class, foreign = [leader], list[ForceFit]()
    for other in bank.groups:
        if other.name in leader.names:
            continue
        described = bank.columns[thin][:, bank.columns_of([other])]
        if difference(np.linalg.qr(described)[0], cause_column) < 0.5:
            alike = other.cause_class == group.cause_class
            (of_class if alike else foreign).append(bank.attempt((*others, other)))
            continue
        item = bank.attempt((*leader.groups, other))
        value, deviation = item.size_of(group)
        ratio, most = value / leader.size_of(group)[0], LIMITS.max_value_ratio
        if not 1.0 / most < ratio < most or abs(value) < 2.0 * deviation:
            return False
    best = min(of_class, key=lambda item: item.rms_n)
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
    """Return what is not physical about unbounded friction and mass, empty if nothing is: a reversed sign reverses both."""
    speed = np.abs(bank.record.raw.speed_m_s[bank.record.judged])
    values, without = bank.unbounded(groups)

    def combined(weights: dict[str, float]) -> tuple[float, float]:
        shares = np.array([weights.get(name, 0.0) for name in bank.body])
        parts, errors = values[: len(shares)], (without - values)[:, : len(shares)]
        return float(shares @ parts), float(jackknife(errors @ shares))

    sizes = {"coulomb_n": float(np.mean(speed)), VISCOUS: float(np.mean(speed**2))}
    (power, spread), (mass, mass_spread) = combined(sizes), combined({"mass_kg": 1.0})
    drives, negative = power < -2.0 * spread, mass < -2.0 * mass_spread
    if not drives and not (negative and power < 2.0 * spread):
        return ""
    friction = f"friction would drive the body ({-power:.3g} W)"
    mass_text = f"{mass:.3g} {bank.record.units.get('kg', 'kg')}"
    if drives and mass > 2.0 * mass_spread:
        return (
            f"{friction}, with a mass of {mass_text}: other forces act on it (pressure, gravity, a "
            "drive that is not recorded?), or the driving force is not all of it"
        )
    odd = [friction] * drives + [f"the mass would be {mass_text}"] * negative
    return (
        f"{' and '.join(odd)}: the sign of the driving force or of the position is reversed "
        "(state scale = -1), or other forces act"
    )
