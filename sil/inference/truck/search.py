"""Hypotheses fitted to a truck's shifts: a healthy truck, each cause, with and without a gearbox.

A healthy truck is fitted from several supplies: with friction and mass these are one long ridge. What each
cause would gain beside it, by secants with all else free, picks those fitted near it. Unless a healthy truck
explains the shifts better than any of these, every cause is also fitted to some of them, in a usual truck with
the healthy one's loads, and again while the best fit leaves more than noise.
The best are fitted again from other random quantities, healthy from where they are, others that look like the
leading one in its truck, and the leading causes in other variants, at other sizes and on the other mounting; those
ahead also at other supplies, with forces and masses in proportion.
Checked by: tests/unit/sil/inference/truck/test_search.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.inference.fit import Show, no_progress
from sil.inference.thresholds import LIMITS
from sil.inference.truck.causes import Cause
from sil.inference.truck.fit import (
    COARSE_M,
    FINE_M,
    FIRST_FACTOR,
    MIDDLE_M,
    Fit,
    Fitter,
)
from sil.inference.truck.gains import gains_of, likeness
from sil.inference.truck.simulator import ShiftModel, trips_of
from sil.inference.workers import Stages, spread_out
from sil.log_replay.recorded_shifts import RecordedShift


@dataclass(frozen=True)
class Effort:
    """How far the search goes; sizes of causes in typical ones, costs and gains in log evidence."""

    supplies: tuple[float, ...] = (0.0, -0.18, -0.09, 0.09)
    """Deviations of the supply from which a healthy truck is fitted, and first looks begin in turn ..."""
    known_supplies: tuple[float, ...] = (0.0, 0.02)
    """... and where the log states it."""
    seeds: tuple[int, ...] = (5, 6, 7, 8)
    """Of random quantities from which it is fitted again unless it explains the shifts."""
    least_gain: float = 1.5
    """Gain by secants from which a cause is fitted beside the healthy truck."""
    near: int = 14
    """Causes that are at most, ..."""
    near_fitted: int = 6
    """... and those of them that are fitted in full."""
    first_shifts: int = 6
    """Shifts that a first look at a cause takes."""
    first_sizes: tuple[float, ...] = (1.5, 3.0, 6.0, 12.0, 25.0)
    first_draws: int = 24
    """Draws of each shift's quantities at either of its scans."""
    tolerance: float = 1e-4
    """Of the integrator in a first look."""
    variants: int = 3
    """Variants of an effect that get one."""
    going_on: int = 2
    """First looks at an effect, the best after some rounds, that go on."""
    wide_varied: int = 12
    """Causes of which sizes around the best first look are tried."""
    wide_fitted: int = 3
    """Causes that are fitted in full, of each first size."""
    hopeless: float = 40.0
    """Cost behind the best from which a coarse fit is not continued ..."""
    most_of_shift: float = 20.0
    """... and what a single shift counts in it at most."""
    behind: float = 18.0
    """Cost behind the best from which a fit is not ended ..."""
    far_behind: float = 12.0
    """... and from which it is not ended a second time."""
    most_chi2: float = 0.1
    """Chi squared per number up to which a fit leaves nothing but noise."""
    turns: int = 3
    """Rounds of first looks, from other random quantities each, as long as the best fit leaves more."""
    slides: tuple[float, ...] = (0.88, 1.12)
    """Factors on supply, loads and mass of a fit, ..."""
    sliding: float = 3.0
    """... if it is at most so far behind the best of its cause in log evidence, ..."""
    most_slides: int = 3
    """... at most so often, ..."""
    least_slide: float = 0.5
    """... as long as they gain so much, ..."""
    behind_slide: float = 1.0
    """... and are not so far behind in cost when coarse."""
    completed: int = 8
    """Causes that are ended at most."""
    contests: int = 2
    """Times that the leading hypothesis is contested, again if it lost."""
    crossed: int = 5
    """Causes fitted in the truck of the leading one."""
    like_sizes: tuple[float, ...] = (0.75, 1.5, 3.0, 6.0, 12.0, 24.0)
    """Sizes near which a cause that is likest to the leading one is sought."""
    contesting: int = 6
    """Causes that are fitted at later_sizes, at most ..."""
    contest: float = 10.0
    """... and how far behind the leading one."""
    later_sizes: tuple[float, ...] = (0.7, 1.4)
    """Of a cause, by its best one."""
    leading: int = 3
    """Causes contested by other variants, and by a healthy truck from where they ended."""


EFFORT: Final = Effort()
FirstLook = tuple[Fit, Cause, float, int]
"""A truck, a cause of a size in it, and a seed."""


@dataclass
class Search:
    """Fitters by whether a gearbox is mounted, those of a first look, and the causes offered.

    first: shifts that a first look takes.
    """

    fitters: dict[bool, Fitter]
    coarse: dict[bool, Fitter]
    first: list[int]
    causes: Sequence[Cause]
    workers: int = 1

    @classmethod
    def of(
        cls,
        shifts: Sequence[RecordedShift],
        parameters: ParameterSet,
        noise_m: float,
        causes: Sequence[Cause],
        workers: int = 1,
        trips_from: Sequence[RecordedShift] = (),
    ) -> Search:
        """Return the search over the shifts of one truck; trips_from: all of its shifts, if these are some."""
        few = spread(shifts, EFFORT.first_shifts)
        first = [k for k, shift in enumerate(shifts) if any(shift is own for own in few)]

        trips = trips_of(trips_from or shifts)

        def fitters(own: Sequence[RecordedShift], **how: float) -> dict[bool, Fitter]:
            return {
                mounted: Fitter(ShiftModel(own, parameters, mounted, trips, **how), noise_m)
                for mounted in (True, False)
            }

        coarse = fitters(few, tolerance=EFFORT.tolerance)
        return cls(fitters(shifts), coarse, first, causes, workers)

    def run(self, show: Show = no_progress) -> list[Fit]:
        """Return all hypotheses that were fitted in full, the healthy ones among them."""
        stages = Stages(show)
        fits = self.healthy_fits(stages)
        healthy = fits[0]
        gains = gains_of(self.fitters[healthy.mounted], healthy, self.causes)
        near = self._near(healthy, gains, stages)
        best, full = _best_of(near, EFFORT.near_fitted), list[Fit]()
        is_explained = self.is_explained(healthy)
        for turn in range(1 if is_explained else EFFORT.turns):
            if not is_explained:
                best += self._wide(healthy, stages, 101 * turn)
            full = self._with_full(full, best, stages)
            if full and self.is_noise(full[0]):
                break
            best = []
        if not full:
            return fits
        full = self._contested(full, stages)
        if is_explained and _is_ahead(full[0], healthy):  # before it is named, all get a first look
            full = self._with_full(full, self._wide(healthy, stages), stages)
            full = self._contested(full, stages)
        if _is_ahead(full[0], healthy):
            contesting = _best_of(full, EFFORT.contesting, _behind, EFFORT.contest)
            sizes = [(f, by) for f in contesting if f.cause for by in EFFORT.later_sizes]
            begun = spread_out(self._at_size, sizes, self.workers, stages.until(92.0))
            full += self._completed(begun, stages.until(95.0), full)
        leading = _best_of(full, EFFORT.leading, _behind, np.inf)
        return fits + full + spread_out(self._without, leading, self.workers, stages.until(98.0))

    def _with_full(self, full: list[Fit], best: Sequence[Fit], stages: Stages) -> list[Fit]:
        """Return full fits, the best first, with those of coarse ones."""
        jobs = [(fit, 5) for fit in _unlike(best)]
        more = self._in_full(jobs, stages.until(75.0), full)
        return sorted(full + more, key=_behind)

    def _contested(self, full: list[Fit], stages: Stages) -> list[Fit]:
        """Return full fits, the best first, with those that contest the leading one, again if it lost."""
        for _ in range(EFFORT.contests):
            leader = full[0].id
            full = full + self._in_full(self._challengers(full), stages.until(85.0), full)
            full.sort(key=_behind)
            if full[0].id == leader or full[0].cause is None:
                break
        return full

    def healthy_fits(self, stages: Stages) -> list[Fit]:
        """Return fits of a healthy truck from several supplies and mountings, the best first."""
        starts = [(True, supply) for supply in self._supplies()] + [(False, 0.0)]
        fits = spread_out(self._healthy, starts, self.workers, stages.until(15.0))
        fits.sort(key=_behind)
        if not self.is_explained(fits[0]):
            again = [(fits[0], seed) for seed in EFFORT.seeds]
            fits += spread_out(self._full, again, self.workers, stages.until(20.0))
            fits.sort(key=_behind)
        return self._with_reference(fits)

    def _with_reference(self, fits: list[Fit]) -> list[Fit]:
        """Return fits, the best first, with evidence by the slopes of one of them, which hypotheses share."""
        for mounted, fitter in self.fitters.items():
            if like := [fit for fit in fits if fit.mounted is mounted]:
                fitter.likeliest = min(like, key=lambda fit: fit.cost)
                fitter.reference = fitter.slopes(fitter.likeliest)
        fits = [self.fitters[fit.mounted].with_evidence(fit) for fit in fits]
        return sorted(fits, key=_behind)

    def on_all(
        self,
        shifts: Sequence[RecordedShift],
        parameters: ParameterSet,
        noise_m: float,
        fits: Sequence[Fit],
        show: Show = no_progress,
    ) -> tuple[Search, list[Fit]]:
        """Return the leading hypotheses of these fits, fitted to more shifts of the same truck."""
        whole = Search.of(shifts, parameters, noise_m, self.causes, self.workers)
        best: dict[str, Fit] = {}
        for fit in sorted(fits, key=_behind):
            best.setdefault(fit.id, fit)
        kept = list(best.values())[: EFFORT.leading]
        if all(fit.cause is not None for fit in kept):
            kept.append(best["healthy"])
        usual = whole.fitters[True].start()
        jobs = [(replace(fit, each=usual.each), 5) for fit in kept]
        return whole, whole._with_reference(spread_out(whole._full, jobs, self.workers, show))

    def is_explained(self, fit: Fit) -> bool:
        """Return whether noise explains what a healthy truck leaves, with ordinary quantities."""
        fitter = self.fitters[fit.mounted]
        is_ordinary = fitter.unit_cost(fit.unit) <= LIMITS.max_truck_strain
        return self.is_noise(fit) and is_ordinary and not fitter.deviating(fit)

    def is_noise(self, fit: Fit) -> bool:
        """Return whether a fit leaves nothing but noise, so that no other could leave much less."""
        return self.fitters[fit.mounted].chi2(fit) <= EFFORT.most_chi2

    def _supplies(self) -> tuple[float, ...]:
        layout = self.fitters[True].layout
        is_known = layout.unit_sd[layout.at["supply"]] <= 0.05
        return EFFORT.known_supplies if is_known else EFFORT.supplies

    def _first_look(self) -> list[Cause]:
        """Return the causes that are fitted coarsely: of each effect the first variants, one in each place."""
        taken: list[Cause] = []
        number = Counter[str]()
        for cause in self.causes:
            most = len(self.causes) if len(cause.others) > 1 else EFFORT.variants
            if number[cause.id] < most:
                number[cause.id] += 1
                taken.append(cause)
        return taken

    def _healthy(self, start: tuple[bool, float]) -> Fit:
        """Fit a healthy truck, at first at another supply."""
        mounted, supply = start
        fitter = self.fitters[mounted]
        rng = np.random.default_rng(1)
        fit = fitter.start()
        if supply == 0.0:
            for error_m, rounds, scans in ((COARSE_M, 6, 2), (MIDDLE_M, 8, 2)):
                for _ in range(scans):
                    fit = fitter.improved(fitter.rescanned(fit, error_m, rng), error_m, rounds)
        else:
            column = fitter.layout.at["supply"]
            fit.unit[column] = supply / fitter.layout.unit_sd[column]
            fit = fitter.rescanned(fit, COARSE_M, rng, 200)
            fit = fitter.improved(fit, MIDDLE_M, 8)
        fit = replace(fit, noise_factor=FIRST_FACTOR)
        fit = fitter.rescanned(fit, FINE_M, rng)
        return fitter.finished(fitter.improved(fit, FINE_M, 8, followed=0), rng)

    def _near(
        self, healthy: Fit, gains: Sequence[tuple[float, float]], stages: Stages
    ) -> list[Fit]:
        """Fit the causes that gain most beside the healthy truck, from there."""
        order = sorted(range(len(gains)), key=lambda k: -gains[k][0])[: EFFORT.near]
        jobs = [
            (healthy, self.causes[k], gains[k][1]) for k in order if gains[k][0] > EFFORT.least_gain
        ]
        fits = spread_out(self._beside, jobs, self.workers, stages.until(25.0))
        if self.is_explained(healthy):
            fits = [fit for fit in fits if fit.cost < healthy.cost - 2.0]
        return fits

    def _beside(self, job: tuple[Fit, Cause, float]) -> Fit:
        healthy, cause, size = job
        fit = replace(healthy, cause=cause, size=0.3 * size)
        return self.fitters[fit.mounted].improved(fit, FINE_M, 5, least=0.5)

    def _wide(self, healthy: Fit, stages: Stages, first_seed: int = 0) -> list[Fit]:
        """Fit every cause to some shifts from several sizes; return the best from each, for all shifts.

        In a usual truck with the loads of the healthy one, also on its mounting. first_seed: of the random quantities.
        """

        def truck(mounted: bool) -> Fit:
            fitter = self.fitters[mounted]
            return fitter.with_loads_of(healthy, fitter.start())

        sizes = EFFORT.first_sizes
        jobs = [
            (truck(mounted), cause, size, seed)
            for mounted in dict.fromkeys((True, healthy.mounted))
            for cause in self._first_look()
            for seed, size in enumerate(cause.sizes(*sizes[: 5 if cause.sign else 3]), first_seed)
        ]
        jobs = self._telling(jobs)
        begun = spread_out(self._begun_on_some, jobs, self.workers, stages.until(37.0))
        begun = self._gone_on(begun, stages.until(40.0))
        around = [
            (truck(fit.mounted), fit.cause, size, first_seed + len(sizes))
            for fit in _best_of(begun, EFFORT.wide_varied, _capped)
            if fit.cause is not None
            for size in (fit.cause.clipped(by * fit.size) for by in EFFORT.later_sizes)
        ]
        begun_at = np.searchsorted(sizes, [abs(size) for *_, size, _ in jobs])
        # sizes far apart may fit alike: the best from each of them go on
        groups = [
            [fit for fit, k in zip(begun, begun_at, strict=True) if k == at]
            for at in range(len(sizes))
        ]
        begun = spread_out(self._begun_on_some, around, self.workers, stages.until(48.0))
        groups.append(self._gone_on(begun, stages.until(50.0)))
        return [fit for group in groups for fit in _best_of(group, EFFORT.wide_fitted, _capped)]

    def _telling(self, jobs: Sequence[FirstLook]) -> list[FirstLook]:
        """Return the first looks whose cause moves a shift, and not as in an earlier one of its effect."""
        kept, seen = list[FirstLook](), set[tuple[str, bytes]]()
        for job, (without, there) in zip(
            jobs, spread_out(self._moved, jobs, self.workers), strict=True
        ):
            if there != without and (job[1].id, there) not in seen:
                kept.append(job)
            seen.add((job[1].id, there))
        return kept

    def _moved(self, job: FirstLook) -> tuple[bytes, bytes]:
        """Return the positions of a first look to a micrometre, without its cause and with it."""
        truck, cause, size, _ = job
        some = self._of_first(truck)
        fits = some, replace(some, cause=cause, size=size)
        where = [self.coarse[truck.mounted].evaluated(fit, MIDDLE_M).position_m for fit in fits]
        without, there = (np.round(x, 6).tobytes() for x in where if x is not None)
        return without, there

    def _gone_on(self, begun: Sequence[Fit], show: Show) -> list[Fit]:
        """Return first looks, of which the best of each effect have gone on."""
        fits, number = list(begun), Counter[str]()
        leading = []
        for k in sorted(range(len(fits)), key=lambda k: _capped(fits[k])):
            number[fits[k].id] += 1
            if number[fits[k].id] <= EFFORT.going_on:
                leading.append(k)
        further = spread_out(self._further, [fits[k] for k in leading], self.workers, show)
        for k, fit in zip(leading, further, strict=True):
            fits[k] = fit
        return fits

    def _begun_on_some(self, job: FirstLook) -> Fit:
        """Fit a cause of a size in a truck to the shifts of a first look."""
        truck, cause, size, seed = job
        fitter, rng = self.coarse[truck.mounted], np.random.default_rng(seed)
        unit, spread = truck.unit.copy(), np.ones_like(truck.spread)
        column, supplies = fitter.layout.at["supply"], self._supplies()
        unit[column] = supplies[seed % len(supplies)] / fitter.layout.unit_sd[column]
        fit = replace(self._of_first(truck), cause=cause, size=size, unit=unit, spread=spread)
        fit = fitter.rescanned(fit, COARSE_M, rng, EFFORT.first_draws)
        fit = fitter.improved(fit, COARSE_M, 3, least=1.0, fixed=True, again=False)
        fit = fitter.rescanned(fit, MIDDLE_M, rng, EFFORT.first_draws)
        return self._of_all(fitter.improved(fit, MIDDLE_M, 6, again=False), truck)

    def _further(self, fit: Fit) -> Fit:
        """Fit a cause further to the shifts of a first look, those farthest off from anew."""
        fitter = self.coarse[fit.mounted]
        some = fitter.evaluated(self._of_first(fit), MIDDLE_M)
        each = fitter.begun_anew(some, MIDDLE_M, np.random.default_rng(4))
        if each is not None:
            some = replace(some, each=each)
        return self._of_all(fitter.improved(some, MIDDLE_M, 8, again=False), fit)

    def _of_first(self, fit: Fit) -> Fit:
        """Return a fit of all shifts as one of those that a first look takes."""
        return replace(fit, each=fit.each[self.first])

    def _of_all(self, some: Fit, fit: Fit) -> Fit:
        """Return a fit of the shifts of a first look as one of all, the others' quantities from `fit`."""
        each = fit.each.copy()
        each[self.first] = some.each
        return replace(some, each=each)

    def _in_full(
        self, jobs: Sequence[tuple[Fit, int]], show: Show, full: Sequence[Fit] = ()
    ) -> list[Fit]:
        """Return full fits, the best first, without causes that are far behind before the last stage; full: those there are."""
        return self._completed(spread_out(self._begun, jobs, self.workers), show, full)

    def _completed(self, begun: Sequence[Fit], show: Show, full: Sequence[Fit] = ()) -> list[Fit]:
        """Fit those to the end that can catch up, and every healthy truck."""
        kept = self._catching_up(begun, EFFORT.behind, full)
        fits = spread_out(self._ended, kept, self.workers)
        leading = self._catching_up(fits, EFFORT.far_behind, full)
        rest = [fit for fit in fits if fit not in leading]
        best = _best_of([*full, *leading], len(full) + len(leading), _behind, EFFORT.behind)
        least = {fit.id: fit.evidence - EFFORT.sliding for fit in best}
        jobs = [(fit, fit.evidence > least.get(fit.id, np.inf)) for fit in leading]
        fits = rest + spread_out(self._ended_again, jobs, self.workers, show)
        return sorted(fits, key=_behind)

    def _catching_up(
        self, fits: Sequence[Fit], behind: float, full: Sequence[Fit] = ()
    ) -> list[Fit]:
        """Return those that are at most so far behind in cost, and every healthy truck.

        As long as the best one leaves more than noise, what it leaves may be gained by others, too.
        """
        costs = [self._whole_cost(fit) for fit in fits]
        near = sorted(c for c, fit in zip(costs, fits, strict=True) if fit.cause)
        best = min([*fits, *full], key=self._whole_cost, default=None)
        if best is not None and not self.is_noise(best):
            behind += self.fitters[best.mounted].misfit_cost(best)
        most = min([min(costs, default=0.0) + behind, *near[: EFFORT.completed][-1:]])
        return [f for c, f in zip(costs, fits, strict=True) if f.cause is None or c <= most]

    def _whole_cost(self, fit: Fit) -> float:
        return self.fitters[fit.mounted].whole_cost(fit)

    def _begun(self, job: tuple[Fit, int]) -> Fit:
        """Fit a hypothesis to all shifts, with more than the noise allowed for."""
        fit, seed = job
        fitter, rng = self.fitters[fit.mounted], np.random.default_rng(seed)
        fit = fitter.improved(fitter.rescanned(fit, MIDDLE_M, rng), MIDDLE_M, 14)
        return self._refined(fit, rng)

    def _refined(self, fit: Fit, rng: np.random.Generator) -> Fit:
        fitter = self.fitters[fit.mounted]
        fit = replace(fit, noise_factor=FIRST_FACTOR, spread=np.ones_like(fit.spread))
        fit = fitter.with_scales(fitter.freed(fitter.improved(fit, FINE_M, 8), rng))
        return fitter.improved(fit, FINE_M, 8)

    def _ended(self, fit: Fit) -> Fit:
        return self.fitters[fit.mounted].finished(fit, np.random.default_rng(9), times=2)

    def _ended_again(self, job: tuple[Fit, bool]) -> Fit:
        """Fit a hypothesis to the end again, and slide it if its supply is not known."""
        fit, slides = job
        fit = self._ended(fit)
        return self._slid(fit) if slides and self._supplies() == EFFORT.supplies else fit

    def _slid(self, best: Fit) -> Fit:
        """Return a fit, or a better one at another supply with forces and masses in proportion: they are one long ridge."""
        for factor in EFFORT.slides:
            further = best
            for _ in range(EFFORT.most_slides):
                there = self._in_proportion(further, factor)
                if there.evidence < further.evidence + EFFORT.least_slide:
                    break
                further = there
            if further is not best:
                return further
        return best

    def _in_proportion(self, fit: Fit, factor: float) -> Fit:
        """Return a fit from a factor on supply, forces and masses; the same fit if it is far behind before its end."""
        fitter, rng = self.fitters[fit.mounted], np.random.default_rng(1)
        unit = fitter.layout.in_proportion(fit.unit, factor)
        there = fitter.rescanned(replace(fit, unit=unit, noise_factor=1.0), MIDDLE_M, rng)
        there = fitter.improved(there, MIDDLE_M, 10)
        if there.cost > fitter.evaluated(fit, MIDDLE_M).cost + EFFORT.behind_slide:
            return fit
        there = self._refined(there, rng)
        if fitter.whole_cost(there) > fitter.whole_cost(fit) + EFFORT.behind:
            return fit
        return self._ended(there)

    def _full(self, job: tuple[Fit, int]) -> Fit:
        return self._ended(self._ended(self._begun(job)))

    def _challengers(self, full: Sequence[Fit]) -> list[tuple[Fit, int]]:
        """Return what contests the leading hypothesis.

        No cause; in its truck the next ones and the likest; other variants of the leading causes; the other mounting.
        """
        best, leading = full[0], _best_of(full, 2, _behind, np.inf)
        jobs = [(replace(fit, cause=None, size=0.0), 9) for fit in leading]
        following = _best_of(full, EFFORT.crossed, _behind, np.inf)[1:]
        crossed = [(fit.cause, fit.size) for fit in following if fit.cause]
        crossed += self._like(best, {fit.id for fit in full})[: EFFORT.crossed - len(crossed)]
        jobs += [(replace(best, cause=cause, size=size), 8) for cause, size in crossed]
        tried = {fit.cause for fit in full}
        near = {fit.id: fit for fit in _best_of(full, EFFORT.leading, _behind, EFFORT.contest)}
        for cause in self.causes:
            if cause.id in near and cause not in tried:
                like = near[cause.id]
                jobs.append((replace(like, cause=cause, size=cause.clipped(like.size)), 8))
        other = self.fitters[not best.mounted]
        jobs.append((replace(best, mounted=not best.mounted, each=best.each * other.mask), 8))
        return jobs

    def _like(self, fit: Fit, fitted: Collection[str]) -> list[tuple[Cause, float]]:
        """Return causes and sizes, the likest first, that could stand in for the cause of a fit in its truck."""
        rows = likeness(self.fitters[fit.mounted], fit, self.causes, EFFORT.like_sizes)
        order = sorted(zip(rows, self.causes, strict=True), key=lambda row: row[0][0])
        best: dict[str, tuple[Cause, float]] = {}
        for (behind, size), cause in order:
            if behind < np.inf and cause.id not in fitted:
                best.setdefault(cause.id, (cause, size))
        return list(best.values())

    def _without(self, fit: Fit) -> Fit:
        """Fit a healthy truck from exactly where the fit of a cause ended."""
        fitter = self.fitters[fit.mounted]
        fit = replace(fit, cause=None, size=0.0, noise_factor=FIRST_FACTOR)
        return fitter.finished(fitter.improved(fit, FINE_M, 12), np.random.default_rng(9))

    def _at_size(self, job: tuple[Fit, float]) -> Fit:
        """Fit a cause from another size, each shift's quantities found anew there."""
        fit, factor = job
        assert fit.cause is not None
        fitter, rng = self.fitters[fit.mounted], np.random.default_rng(3)
        size = fit.cause.clipped(factor * fit.size)
        fit = fitter.start(fit.cause, size)
        for error_m in (COARSE_M, MIDDLE_M):
            fit = fitter.rescanned(fit, error_m, rng, 64)
            fit = fitter.improved(fit, error_m, 6, fixed=True)
        return self._refined(fitter.improved(fit, MIDDLE_M, 9), rng)


def spread(shifts: Sequence[RecordedShift], most: int) -> list[RecordedShift]:
    """Return at most so many shifts, evenly spread, of each kind its share, those that failed among them.

    Into gear and out of it come in turn: every second shift would be of one kind.
    """
    if len(shifts) <= most:
        return list(shifts)
    # stable: in time among shifts of one kind
    order = sorted(
        range(len(shifts)), key=lambda k: (shifts[k].failed, shifts[k].start, shifts[k].end)
    )
    taken = np.linspace(0, len(shifts) - 1, most).round().astype(int)
    return [shifts[k] for k in sorted(order[at] for at in taken)]


def _unlike(fits: Sequence[Fit]) -> list[Fit]:
    """Return fits, the best first, without those like a better one: of a cause at nearly its size."""
    kept: list[Fit] = []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        like = [k for k in kept if (k.name, k.mounted) == (fit.name, fit.mounted)]
        if not any(0.8 < fit.size / k.size < 1.25 for k in like if k.size):
            kept.append(fit)
    return kept


def _is_ahead(fit: Fit, healthy: Fit) -> bool:
    """Return whether a cause explains more than a healthy truck."""
    return fit.cause is not None and fit.evidence > healthy.evidence + 3.0


def _behind(fit: Fit) -> float:
    """Return by what a full fit is behind others."""
    return -fit.evidence


def _capped(fit: Fit) -> float:
    """Return the cost of a coarse fit; a shift counts no more than a stuck one: it will begin anew."""
    assert fit.per_shift is not None
    return fit.cost - float(np.maximum(fit.per_shift - EFFORT.most_of_shift, 0.0).sum())


def _best_of(
    fits: Sequence[Fit],
    most: int,
    key: Callable[[Fit], float] = lambda fit: fit.cost,
    hopeless: float = EFFORT.hopeless,
) -> list[Fit]:
    """Return the best fit, by least key, of each of the best effects that are not hopeless."""
    best: dict[str, Fit] = {}
    for fit in sorted(fits, key=key):
        best.setdefault(fit.id, fit)
    kept = list(best.values())[:most]
    return [fit for fit in kept if key(fit) < key(kept[0]) + hopeless]
