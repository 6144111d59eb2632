"""Driving forces that are late or early against the position: found, and taken off within a step.

Checked by: tests/unit/sil/inference/force/test_delay.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sil.campaign.campaign import Floats
from sil.inference.force.fit import Bank, ForceChoice, TermGroup, choose
from sil.inference.force.record import FEWEST_SAMPLES, FEWEST_STROKES, Recorded
from sil.inference.thresholds import LIMITS


@dataclass(frozen=True)
class ForceDelay:
    """By how much something is late [s], and what is chosen without that."""

    what: str
    late_s: float
    choice: ForceChoice

    def __str__(self) -> str:
        """Return what is late or early, and by how much."""
        size = f"{abs(self.late_s):.3g} s {'late' if self.late_s > 0.0 else 'early'}"
        return f"the {self.what} is {size} against the position"

    def is_within(self, step_s: float) -> bool:
        """Return whether it is a delay within a sampling step [s]."""
        return abs(self.late_s) <= (1.0 + LIMITS.step_tolerance) * step_s


def without_delay(record: Recorded) -> tuple[ForceChoice, str, str]:
    """Return what is chosen, a finding about a delay, and a doubt about one that forbids conclusions.

    A delay within a sampling step is taken off if noise does not explain what is left with it. A longer
    one forbids conclusions, unless noise explains that and the same causes lead without it. None is
    sought where noise explains what a plain body leaves.
    """
    choice = choose(record)
    if choice.is_explained and not choice.leader.groups:
        return choice, "", ""
    what, recorded_n = "driving force", record.recorded_n
    ways = [(what, False), (f"{what} with its pressures", True)]
    if not (record.body.piston_area_m2 or record.body.area_2_m2):
        del ways[1]
    elif np.ptp(recorded_n) == 0.0 or np.array_equal(recorded_n, record.raw.force_n):
        ways = [(what, True)]
    delays = [item for what, too in ways if (item := _delay(choice, what, too))]
    delay = min(delays, key=lambda item: item.choice.leader.over_noise, default=None)
    if delay is None:
        return choice, "", ""
    if delay.is_within(record.step_s):
        if choice.is_explained:
            return choice, "", ""
        why = "within a sampling step (a command that is held from sample to sample?)"
        return delay.choice, f"{delay}, {why}: taken off", ""
    remedy = f"correct the time base, or state delay_s = {delay.late_s:.4g} for it in [columns]"
    text = f"{delay}: {remedy}"
    if choice.is_explained and delay.choice.leader.ids == choice.leader.ids:
        return choice, text, ""
    return choice, "", text


def _delay(choice: ForceChoice, what: str, pressures: bool) -> ForceDelay | None:
    """Return the delay that explains what the leader leaves, None if there is none; pressures: whether those are late, too.

    The force is moved against all columns first, so that no cause is taken for a delay, then against
    those of the leader, so that none makes up for a part of it, and last by less than a step.
    """
    record, step_s = choice.bank.record, choice.bank.record.step_s

    def moved(late_s: float) -> ForceChoice:
        return choose(sooner(record, late_s, pressures)) if late_s else choice

    steps = _lag(choice.bank, choice.bank.groups, pressures)
    now = moved(steps * step_s)
    for _ in range(2):
        more = _lag(now.bank, now.leader.groups, pressures)
        if not more:
            break
        steps += more
        now = moved(steps * step_s)
    whole_s = steps * step_s
    late_s = whole_s + _rest_s(now, pressures)
    if abs(late_s + 0.5 * step_s) < LIMITS.step_tolerance * step_s:
        late_s = -0.5 * step_s
    if not late_s:
        return None
    delay = ForceDelay(what, late_s, now if late_s == whole_s else moved(late_s))
    if delay.is_within(step_s):
        before, after = (item.closest.over_noise for item in (choice, delay.choice))
        return delay if after**2 - 1.0 < 0.8 * (before**2 - 1.0) else None
    (before, *parts), (after, *left) = _excess(choice), _excess(delay.choice)
    if after > LIMITS.max_share_beside_delay * before:
        return None
    noise = LIMITS.max_residual_ratio**2 - 1.0
    most = np.maximum(noise, LIMITS.max_share_beside_delay * np.array(parts))
    gain = 0.5 * choice.leader.count * (before - after)
    is_sure = gain >= LIMITS.needed_gain(len(choice.leader.squares))
    return delay if is_sure and np.all(left <= most) else None


def _excess(choice: ForceChoice) -> list[float]:
    """Return the leader's excess, in squares of the noise: held out, and of both halves of the samples."""
    bank, leader = choice.bank, choice.leader
    halves = np.array_split(bank.target - bank.model_n(leader), 2)
    squares = [float(np.mean(rest**2)) / leader.noise_n**2 for rest in halves]
    return [item - 1.0 for item in (leader.over_noise**2, *squares)]


def _lag(bank: Bank, groups: Sequence[TermGroup], pressures: bool) -> int:
    """Return by how many sampling steps the force is late against a hypothesis, 0 if too few samples can be moved."""
    record = bank.record
    lengths = np.diff(np.append(record.starts, len(record.judged)))
    most = min(int(0.5 / record.step_s), int(lengths.max()) // 8)
    rows = np.flatnonzero(record.judged)
    inside = np.flatnonzero(record.away_from_ends(most)[rows])
    blocks = np.unique(record.raw.block[rows[inside]])
    if len(inside) < FEWEST_SAMPLES // 2 or len(blocks) < FEWEST_STROKES:
        return 0
    picked = inside[:: max(1, len(inside) // 5000)]
    base = np.linalg.qr(bank.columns[picked][:, bank.columns_of(groups)])[0]
    force = record.filtered(record.raw.force_n if pressures else record.recorded_n)
    fixed = bank.target[picked] - force[rows[picked]]

    def best(lags: NDArray[np.int64]) -> int:
        moved = force[rows[picked][:, None] + lags]
        target = moved + fixed[:, None]
        left = np.sum(target**2, axis=0) - np.sum((base.T @ target) ** 2, axis=0)
        return int(lags[np.argmin(left / (np.var(moved, axis=0) + 1e-300))])

    coarse = max(1, most // 250)
    near = best(np.unique(np.r_[-most : most + 1 : coarse, max(-8, -most) : min(8, most) + 1]))
    return best(np.arange(max(-most, near - coarse), min(most, near + coarse) + 1))


def _rest_s(choice: ForceChoice, pressures: bool) -> float:
    """Return by how much less than a step the force is late [s] in what the closest hypothesis leaves, 0 if unsure."""
    bank, record = choice.bank, choice.bank.record
    base = np.linalg.qr(bank.columns[:, bank.columns_of(choice.closest.groups)])[0]
    rate = record.filtered(record.raw.force_n if pressures else record.recorded_n, 1)
    both = (bank.target, rate[record.judged])
    rest, moved = (values - base @ (base.T @ values) for values in both)
    size = float(moved @ moved) + 1e-300
    late_s = -float(rest @ moved) / size
    error_s = float(np.sqrt(rest @ rest / size / choice.closest.count))
    most_s = (1.0 + LIMITS.step_tolerance) * record.step_s
    return late_s if LIMITS.min_standard_errors * error_s < abs(late_s) <= most_s else 0.0


def sooner(record: Recorded, late_s: float, pressures: bool) -> Recorded:
    """Return a record with its force, and pressures if stated, taken earlier [s], less what then lacks at the ends.

    What is held over a step h acts as its mean, F(t - h/2) + h^2/24 F'' to the next order in h.
    """
    from scipy.ndimage import correlate1d, shift

    curvature = 1.0 / 24.0 if late_s == -0.5 * record.step_s else 0.0

    def moved(values: Floats) -> Floats:
        parts = np.split(values, record.starts[1:])
        parts = [shift(p, -late_s / record.step_s, mode="nearest") for p in parts]
        mean = (curvature, 1.0 - 2.0 * curvature, curvature)
        return np.concatenate([correlate1d(p, mean, mode="nearest") for p in parts])

    recorded_n, added = moved(record.recorded_n), record.raw.force_n - record.recorded_n
    pressure = record.raw.pressure_pa
    if pressures:
        added, pressure = moved(added), None if pressure is None else moved(pressure)
    raw = replace(record.raw, force_n=recorded_n + added, pressure_pa=pressure)
    judged = record.judged & record.away_from_ends(abs(late_s) / record.step_s)
    return replace(record, raw=raw, recorded_n=recorded_n, judged=judged)
