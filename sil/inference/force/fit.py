"""Balances of forces: every hypothesis by linear least squares, groups of strokes held out in turn.

D = M a + F_C sgn v + d v + F_0 + causes, all filtered alike. The columns of all hypotheses are
reduced once, group by group, to their products; a hypothesis is then the solution of a few equations.
Checked by: tests/unit/sil/inference/force/test_diagnosis.py
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plant.effects.force_term import Floats, ForceTerm, Motion
from sil.inference.evidence import ChannelMisfit, Misfit
from sil.inference.force.record import Recorded
from sil.inference.force.terms import SMOOTH, Term, centred, difference, hats, terms
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.verdict import Explanation, Verdict, decide

VISCOUS = "viscous_n_s_m"


@dataclass(frozen=True)
class TermGroup:
    """Columns that enter together: one of a form, several of a smooth function."""

    name: str
    id: str
    cause_class: str
    form: ForceTerm | None
    columns: tuple[int, ...]


@dataclass
class ForceFit(Explanation):
    """A hypothesis, fitted.

    values, deviations: [k] of the body's and the groups' columns; squares: held-out sums of each group
    of strokes [N^2]; noise_n: expected rms of its residual [N]; count: independent samples; is_robust:
    its causes come out alike whatever describes its residual; removable: share of its squares that an
    acceptable cause surely removes.
    """

    groups: tuple[TermGroup, ...]
    values: Floats
    deviations: Floats
    squares: Floats
    samples: int
    body: tuple[str, ...]
    noise_n: float = 1.0
    expected_n: float = 1.0
    count: float = 1.0
    probability: float = 0.0
    is_robust: bool = False
    removable: float = 0.0

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what it leaves: the noise is an estimate, of which no cause removes much."""
        return self.whole.is_noise and self.removable < LIMITS.max_removable_share

    @property
    def shared_with_unnamed(self) -> float:
        """Probability that its causes act if something without a name does."""
        return LIMITS.robust_share if self.is_robust else LIMITS.pair_prior

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its terms."""
        return tuple(group.name for group in self.groups)

    @property
    def name(self) -> str:
        """Name of the hypothesis."""
        return " + ".join(self.names) or "plain body"

    @property
    def ids(self) -> tuple[str, ...]:
        """Identifiers of its causes."""
        return tuple(group.id for group in self.groups)

    @property
    def rms_n(self) -> float:
        """Held-out rms [N]."""
        return float(np.sqrt(self.squares.sum() / self.samples))

    @property
    def over_noise(self) -> float:
        """Held-out rms over the noise of the balance; 1 = explained."""
        return self.rms_n / self.noise_n

    @property
    def score(self) -> float:
        """Held-out cost in log evidence."""
        return 0.5 * self.count * self.over_noise**2

    @cached_property
    def whole(self) -> Misfit:
        """Misfit against noise and the scatter between strokes."""
        rms, explained = self.over_noise, LIMITS.max_residual_ratio
        band = max(explained, min(3.0, explained * self.expected_n / self.noise_n))
        channel = ChannelMisfit(rms, round(self.count), band)
        excess = self.count * (rms**2 - 1.0)
        return Misfit({"force_n": channel}, excess, self.count * (band**2 - 1.0), round(self.count))

    def value(self, name: str) -> tuple[float, float]:
        """Return value and deviation of a parameter of the body."""
        k = self.body.index(name)
        return float(self.values[k]), float(self.deviations[k])

    def size_of(self, group: TermGroup) -> tuple[float, float]:
        """Return value and deviation of a group's first column."""
        before = self.groups[: self.groups.index(group)]
        k = len(self.body) + sum(len(item.columns) for item in before)
        return float(self.values[k]), float(self.deviations[k])

    def physical(self) -> bool:
        """Return whether the causes have physical signs and exclude zero."""
        for group in self.groups:
            if group.form is None:
                continue
            value, deviation = self.size_of(group)
            if abs(value) < 2.0 * deviation or (group.form.sign and value < 0.0):
                return False
            if group.form.parameter == VISCOUS and VISCOUS in self.body:  # a part of it
                viscous, spread = self.value(VISCOUS)
                if abs(value) > viscous + 2.0 * float(np.hypot(spread, deviation)):
                    return False  # friction would drive the body one way
        return True


def gain_in_errors(item: ForceFit, other: ForceFit) -> float:
    """Return how much less `item` leaves of held-out squares, or of their shares, than `other`, in standard errors."""
    gains = other.squares - item.squares
    shares = gains / (np.maximum(other.squares, item.squares) + 1e-300)
    root = len(gains) ** 0.5
    return max(float(d.sum() / (np.std(d, ddof=1) * root + 1e-300)) for d in (gains, shares))


class Bank:
    """All columns [n, k] at the judged samples in N per unit, the body's first, and what least squares needs of them.

    target: [n] in N; groups: what may be added; missing: why a term is not offered, by name.
    """

    def __init__(self, record: Recorded) -> None:
        self.record = record
        raw, rows = record.raw, record.judged
        stated = record.body.mass_kg
        target = record.filtered(raw.force_n)
        if stated is not None:
            target = target - stated * raw.acceleration_m_s2
        self.target = target[rows]
        self.missing: dict[str, str] = {}
        self.groups: list[TermGroup] = []
        self._columns: list[Floats] = []
        self.body = self._add_body(raw, stated is None)
        self._base = np.linalg.qr(np.column_stack(self._columns))[0]
        for name, term in terms().items():
            self._add_term(name, term, raw)
        snap = record.filtered(raw.position_m, 4)[rows]
        if np.std(snap) > 10.0 * record.position_sd_m * record.gain_of(4):
            # D = M a - (m^2 / k) x'''' of a mass m on a spring k: a joint that gives way
            self._add("fourth derivative of position", UNNAMED, "flexibility", None, snap)
        self._reduce()

    def is_constant(self) -> bool:
        """Return whether the driving force, less the stated mass's, is constant: nothing to explain."""
        return bool(np.ptp(self.target) <= 1e-6 * np.max(np.abs(self.target)))

    def _add_body(self, raw: Motion, free_mass: bool) -> tuple[str, ...]:
        record, rows = self.record, self.record.judged
        # the mean sign over a sampling step in which the motion turns
        half = 0.5 * record.step_s * np.abs(raw.acceleration_m_s2) + 1e-300
        sign = np.clip(raw.speed_m_s / half, -1.0, 1.0)
        table = {
            "coulomb_n": record.filtered(sign)[rows],
            VISCOUS: raw.speed_m_s[rows],
            "offset_n": np.ones(np.count_nonzero(rows)),
        }
        mass, noise = raw.acceleration_m_s2[rows], record.position_sd_m * record.gain_of(2)
        if free_mass and np.std(mass) >= LIMITS.min_standard_errors * noise:
            table["mass_kg"] = mass
        elif free_mass:
            self.missing["mass_kg"] = (
                "not determined: the acceleration stays within its noise; faster strokes would determine it"
            )
        reasons = {
            VISCOUS: "the speed hardly varies; strokes at several speeds would determine it",
            "offset_n": "the body moves one way only; strokes both ways would separate it from friction",
        }
        determined: list[str] = []
        for name, column in table.items():
            base = np.linalg.qr(np.array(self._columns).reshape(-1, len(column)).T)[0]
            if difference(base, column) < LIMITS.min_column_share:
                why = reasons.get(name, "moves with the others; other speeds would separate them")
                self.missing[name] = f"not determined: {why}"
            else:
                determined.append(name)
                self._columns.append(column)
        return tuple(determined)

    def _add_term(self, name: str, term: Term, raw: Motion) -> None:
        record, form = self.record, term.form
        if form.needs_pressure and raw.pressure_pa is None:
            return
        before = len(self._columns)
        for shape in form.shapes(raw):
            column = record.filtered(form.feature(raw, shape))[record.judged]
            if difference(self._base, column) >= LIMITS.min_column_share:
                if name == "stiffness_cubic":  # whose middle need not be that of the travel
                    square = record.filtered(centred(raw) ** 2)[record.judged]
                    column = np.column_stack([column, square])
                self._add(name, term.id, term.cause_class, form, column)
        if len(self._columns) == before:
            what = "pressure" if form.needs_pressure else "motion"
            self.missing[name] = (
                f"not judged: cannot be distinguished from the plain body here; strokes with other {what} would show it"
            )

    def _add(
        self, name: str, id_: str, cause_class: str, form: ForceTerm | None, table: Floats
    ) -> None:
        first = len(self._columns)
        self._columns += list(table.reshape(len(self.target), -1).T)
        columns = tuple(range(first, len(self._columns)))
        self.groups.append(TermGroup(name, id_, cause_class, form, columns))

    def add_smooth(self) -> list[TermGroup]:
        """Add functions without a form; return their groups."""
        raw, first = self.record.raw, len(self.groups)
        for name, (cause_class, over, times) in SMOOTH.items():
            values, factor = over(raw), None if times is None else times(raw)
            if len(values) and (factor is None or len(factor)):
                column = self.record.filtered(hats(values, factor))[self.record.judged]
                self._add(name, UNNAMED, cause_class, None, column)
        self._reduce()
        return self.groups[first:]

    def _reduce(self) -> None:
        table = np.column_stack(self._columns)
        self.scale = np.sqrt(np.mean(table**2, axis=0)) + 1e-300
        self.columns = table / self.scale
        beyond = self.columns - self._base @ (self._base.T @ self.columns)
        beyond /= np.sqrt(np.sum(beyond**2, axis=0)) + 1e-300
        self._correlation = beyond.T @ beyond
        self.fold = self.record.raw.block[self.record.judged]
        self._grams, self._sides, self._squares = products(self.columns, self.target, self.fold)
        # against the motion, on average over each stroke
        sign = np.sign(self.record.raw.speed_m_s[self.record.judged])
        stroke = np.unique(self.record.stroke[self.record.judged], return_inverse=True)[1]
        order = np.argsort(stroke, kind="stable")
        self._sizes = np.bincount(stroke)
        first = np.cumsum(self._sizes) - self._sizes
        both = np.column_stack([self.columns, self.target]) * sign[:, None]
        self._means = np.add.reduceat(both[order], first) / self._sizes[:, None]

    def columns_of(self, groups: Sequence[TermGroup]) -> list[int]:
        """Return the columns of a hypothesis, the body's first."""
        return [*range(len(self.body)), *(c for group in groups for c in group.columns)]

    def attempt(self, groups: Sequence[TermGroup]) -> ForceFit:
        """Fit a hypothesis with every group of strokes held out in turn; deviations by jackknife."""
        picked = self.columns_of(groups)
        grams, sides = self._grams[:, picked][:, :, picked], self._sides[:, picked]
        values, without = solved(grams, sides)
        free = jackknife(without - values)
        # mass and friction are not negative: what comes out so is left out
        kept = list(range(len(picked)))
        signed = [k for k, name in enumerate(self.body) if name != "offset_n"]
        while signed:
            worst = min(signed, key=lambda k: values[k])
            if values[worst] >= 0.0:
                break
            signed.remove(worst)
            kept.remove(worst)
            values, without = np.zeros_like(values), np.zeros_like(without)
            values[kept], without[:, kept] = solved(grams[:, kept][:, :, kept], sides[:, kept])
        squares = (
            self._squares
            - 2.0 * np.sum(without * sides, axis=1)
            + np.einsum("fi,fij,fj->f", without, grams, without)
        )
        scale = self.scale[picked]
        deviations = np.where(values == 0.0, free, jackknife(without - values)) / scale
        state = values / scale, deviations, np.maximum(squares, 0.0)
        return ForceFit(tuple(groups), *state, len(self.target), self.body)

    def unbounded(
        self, groups: Sequence[TermGroup], rows: NDArray[np.bool_] | None = None
    ) -> tuple[Floats, Floats]:
        """Return a hypothesis' values [k] without bounds, by all or some `rows` [n], and with each group of strokes left out [f, k]."""
        use = np.ones(len(self.target), dtype=bool) if rows is None else rows
        picked = self.columns_of(groups)
        grams, sides, _ = products(self.columns[use][:, picked], self.target[use], self.fold[use])
        values, without = solved(grams, sides)
        return values / self.scale[picked], without / self.scale[picked]

    def free_rms(self, group: TermGroup) -> float:
        """Return the rms of what one unit of a group changes that the body cannot make up [N]."""
        k = group.columns[0]
        column = self.columns[:, k] * self.scale[k]
        return float(np.sqrt(np.mean((column - self._base @ (self._base.T @ column)) ** 2)))

    def model_n(self, item: ForceFit) -> Floats:
        """Return the force of a hypothesis [n] in N, without the stated mass's."""
        picked = self.columns_of(item.groups)
        return np.asarray(self.columns[:, picked] @ (item.values * self.scale[picked]))

    def all_tried(self) -> list[ForceFit]:
        """Return the plain body, every term with its best shape alone and in pairs, some triples."""
        best = self._best((group,) for group in self.groups)
        pairs = self._best(itertools.combinations(self.groups, 2))
        leading = sorted(pairs, key=lambda item: item.rms_n)[:5]
        triples = self._best((*pair.groups, group) for pair in leading for group in self.groups)
        return [self.attempt(()), *best, *pairs, *triples]

    def _best(self, sets: Iterable[tuple[TermGroup, ...]]) -> list[ForceFit]:
        """Return the hypotheses of sets of groups, of each set of names the one that leaves least."""
        best: dict[frozenset[str], ForceFit] = {}
        for groups in sets:
            names = frozenset(group.name for group in groups)
            if len({group.id for group in groups}) < len(groups) or self._alike(groups):
                continue
            item = self.attempt(groups)
            if names not in best or item.rms_n < best[names].rms_n:
                best[names] = item
        return list(best.values())

    def _alike(self, groups: Sequence[TermGroup]) -> bool:
        """Return whether the data hardly separate single columns."""
        pairs = itertools.combinations([group.columns[0] for group in groups], 2)
        return any(abs(self._correlation[i, j]) > 0.99**0.5 for i, j in pairs)

    def calibrate(self, tried: Sequence[ForceFit]) -> None:
        """State the noise: of the channels through the best balance, and the scatter of strokes."""
        best = min(tried, key=lambda item: item.rms_n)
        stated = self.record.body.mass_kg
        mass = best.value("mass_kg")[0] if "mass_kg" in self.body else (stated or 0.0)
        viscous = best.value(VISCOUS)[0] if VISCOUS in self.body else 0.0
        # a residual of 1e-3 of the driving force is explained: no model of a body is better
        least = 1e-3 * float(np.sqrt(np.mean(self.target**2)))
        noise = max(self.record.balance_sd_n(mass, viscous), least, 1e-300)
        correlated = max(1.0, 2.0 * np.pi**0.5 * self.record.width / self.record.stride)
        sizes = self._sizes
        for item in tried:
            picked = self.columns_of(item.groups)
            means = self._means[:, -1] - self._means[:, picked] @ (item.values * self.scale[picked])
            spread = float(np.average(means**2 - noise**2 * correlated / sizes, weights=sizes))
            coulomb = item.value("coulomb_n")[0] if "coulomb_n" in self.body else 0.0
            # Coulomb friction of a healthy body may vary by 5 % from stroke to stroke
            scatter = min(max(spread, 0.0) ** 0.5, 0.05 * max(coulomb, 0.0))
            item.noise_n = noise
            item.expected_n = float(np.hypot(noise, scatter))
            item.count = item.samples / correlated


def products(
    columns: Floats, target: Floats, fold: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats]:
    """Return the products of columns [n, k] and target [n] in each group held out: [f, k, k], [f, k], [f]."""
    rows = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    parts = [(columns[r], target[r]) for r in rows]
    return (
        np.array([c.T @ c for c, _ in parts]),
        np.array([c.T @ y for c, y in parts]),
        np.array([float(y @ y) for _, y in parts]),
    )


def solved(grams: Floats, sides: Floats) -> tuple[Floats, Floats]:
    """Return the solution of products [f, k, k], [f, k]: [k], and with every group held out [f, k]."""
    gram, side = grams.sum(axis=0), sides.sum(axis=0)
    guard = 1e-10 * np.trace(gram) * np.eye(len(side))
    without = np.linalg.solve(gram - grams + guard, (side - sides)[:, :, None])[:, :, 0]
    return np.linalg.solve(gram + guard, side), without


def jackknife(differences: Floats) -> Floats:
    """Return standard deviations [k] from solutions with each group of strokes left out, less the whole [f, k]."""
    count = len(differences)
    return np.asarray(np.sqrt((count - 1) / count * np.sum(differences**2, axis=0)))


# --- which of them are acceptable, and which leads ------------------------------------------
@dataclass(frozen=True)
class ForceChoice:
    """The hypotheses about a record: tried, the plain body first; judged, the best first; the verdict."""

    bank: Bank
    tried: Sequence[ForceFit]
    judged: Sequence[ForceFit]
    verdict: Verdict[ForceFit]

    @property
    def leader(self) -> ForceFit:
        """The hypothesis accepted."""
        return self.verdict.leader

    @property
    def closest(self) -> ForceFit:
        """The hypothesis that leaves least, acceptable or not."""
        return min(self.tried, key=lambda item: item.rms_n)

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what the leader leaves."""
        return self.leader.rms_n <= LIMITS.max_residual_ratio * self.leader.noise_n


def choose(record: Recorded) -> ForceChoice:
    """Fit all hypotheses to a record and decide between those that are physical."""
    bank = Bank(record)
    tried = [bank.attempt(())] if bank.is_constant() else bank.all_tried()
    bank.calibrate(tried)
    by_names = {frozenset(item.names): item for item in tried}
    judged = [item for item in tried if acceptable(item, by_names)]
    judged.sort(key=lambda item: item.score)
    plain, sure = tried[0], 2.0 * LIMITS.min_standard_errors
    while True:
        least = min(
            i.squares.sum() for i in judged if i is plain or gain_in_errors(i, plain) > sure
        )
        plain.removable = 1.0 - float(least / (plain.squares.sum() + 1e-300))
        verdict = decide(judged, len(plain.squares))
        if all(has_one_value(bank, verdict.leader, group) for group in verdict.leader.groups):
            return ForceChoice(bank, tried, judged, verdict)
        judged.remove(verdict.leader)


def has_one_value(bank: Bank, item: ForceFit, group: TermGroup) -> bool:
    """Return whether a cause has the same value in both halves of the samples, by each condition.

    One that only makes up for another has not; halves that determine it poorly contradict nothing.
    """
    if group.id == UNNAMED:
        return True
    k, (value, _) = bank.columns_of(item.groups).index(group.columns[0]), item.size_of(group)
    raw = bank.record.raw
    speed, acceleration = np.abs(raw.speed_m_s), np.abs(raw.acceleration_m_s2)
    for condition in (speed, acceleration, raw.position_m, np.abs(centred(raw))):
        values = condition[bank.record.judged]
        middle = np.median(values)
        for rows in (values < middle, values >= middle):
            if len(np.unique(bank.fold[rows])) < 2:
                continue
            half, without = bank.unbounded(item.groups, rows)
            ratio, error = half[k] / value, 2.0 * jackknife(without - half)[k] / abs(value)
            most = LIMITS.max_value_ratio
            if ratio + error < 1.0 / most or ratio - error > most:
                return False
    return True


def acceptable(item: ForceFit, by_names: dict[frozenset[str], ForceFit]) -> bool:
    """Return whether a hypothesis is physical and gains by each of its causes."""
    if not item.physical():
        return False
    for name in item.names:
        without = by_names[frozenset(item.names) - {name}]
        if gain_in_errors(item, without) < LIMITS.min_standard_errors:
            return False
        if without.groups and without.rms_n <= LIMITS.max_residual_ratio * without.noise_n:
            return False  # nothing is missing: the cause corrects the form of the other one
        if item.whole.excess > 0.5 * max(without.whole.excess, 0.0):
            return False
    return True
