"""Search over hypotheses: healthy, single causes, pairs, judgement, challenge of the leader.

Hypotheses are found with the training blocks alone; the held-out ones judge.
Checked by: tests/unit/sil/inference/test_search.py, test_diagnose.py
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plant.effects.effect import Starts
from plant.errors import IntegrationError
from sil.inference.candidate import Candidate, compatible, scaled_of
from sil.inference.evidence import inexact_squares, misfit, strained
from sil.inference.fit import FARTHEST_SD, FitResult, Fitter, Show, no_progress
from sil.inference.problem import Block, Floats, Problem
from sil.inference.screening import Score, screen
from sil.inference.verdict import HeldOutFits, Judged, Verdict, acceptable, decide, judge
from sil.inference.workers import Stages, fitted


@dataclass(frozen=True)
class Budget:
    """How far a search goes; measured by `python -m tests.bench diagnosis`."""

    first_iterations: int = 3
    last_iterations: int = 10
    valley_iterations: int = 30
    own_iterations: int = 3
    """Of a fit that begins far off: with the hypothesis' own parameters alone."""
    far_cost_per_number: float = 3.0
    """From here on a fit begins far off."""
    linear_excess_per_number: float = 1.0
    """Up to here the healthy fit's linear scores can be trusted."""
    min_linear_gain: float = 12.0
    """Gain in cost that a further effect must promise to be tried."""
    sample_blocks: int = 8
    """Blocks that first fits use."""
    approached: int = 14
    """Causes that are fitted whole at least, ..."""
    max_approached_ratio: float = 2.0
    """... and those whose cost, tolerances aside, is at most so many times the least."""
    singles: int = 6
    pairs: int = 5
    always_finished: int = 3
    max_cost_ratio: float = 6.0
    """Cost over the best one's up to which more first fits than `always_finished` are finished."""
    parents: int = 3
    children: int = 3
    crossed: int = 7
    """The best singles, tried in pairs with each other."""
    outstanding_ratio: float = 50.0
    """A single whose cost is smaller by this factor than any other's is part of every pair."""
    alike_evidence: float = 4.0
    """Log evidence below which the data cannot distinguish two causes."""
    terms: int = 2
    term_iterations: int = 3
    max_unexplained_share: float = 1e-3
    """Share of the healthy misfit, beyond noise, that is a detail of a cause's form."""


BUDGET = Budget()


@dataclass(frozen=True)
class Task:
    """One fit to run: candidates, where each begins, the healthy part's beginning, and the fit whose derivatives serve."""

    candidates: tuple[Candidate, ...]
    starts: tuple[tuple[tuple[float, ...], ...], ...]
    begin: tuple[Floats, Floats] | None = None
    iterations: int = BUDGET.first_iterations
    parent: str = ""

    @classmethod
    def beside(
        cls, fit: FitResult, item: Candidate, starts: Iterable[tuple[float, ...]], **others: Any
    ) -> Task:
        """Return the fit of one more candidate, from a fit's optimum and each of its own starts."""
        points = tuple((*fit.point, start) for start in starts)
        return cls((*fit.candidates, item), points, (fit.shared, fit.stroke), **others)


class Fits(dict[str, FitResult]):
    """Fits by name."""

    def add(self, fit: FitResult | None) -> None:
        """Store a fit, if any, unless a better one of the same hypothesis, in any order, is there."""
        if fit is None:
            return
        causes = {item.name for item in fit.candidates}
        same = (name for name, f in self.items() if {c.name for c in f.candidates} == causes)
        old = next(same, "")
        if not old or fit.cost < self[old].cost:
            self.pop(old, None)
            self[fit.name] = fit

    def ordered(self) -> list[FitResult]:
        """All fits, best evidence first."""
        return sorted(self.values(), key=lambda fit: fit.evidence())

    def of_size(self, count: int) -> list[FitResult]:
        """Fits of that many causes, best first."""
        return [fit for fit in self.ordered() if len(fit.candidates) == count]


class Search:
    """Fits hypotheses, terms without a form last, to the training blocks of a problem; the held-out ones conclude."""

    def __init__(
        self,
        model: Problem,
        candidates: Sequence[Candidate],
        training: Sequence[int],
        held_out: Sequence[int] = (),
        terms: Sequence[Candidate] = (),
        workers: int = 1,
        progress: Show = no_progress,
    ) -> None:
        self.model = model
        self.fitter = Fitter(model)
        self.candidates, self.terms = list(candidates), list(terms)
        self.training, self.held_out = tuple(training), tuple(held_out)
        self.sample = _sample_of(model, self.training)
        self.sample_size = sum(len(model.measured[k]) for k in self.sample)
        self.workers = workers
        self.stages = Stages(progress)
        self.healthy: FitResult
        self.fits = Fits()
        self.first: list[FitResult] = []
        self.parent_blocks: dict[str, dict[int, Block]] = {}
        self.varied: set[str] = set()
        self.scores: list[Score] = []
        self.scores_beside: dict[str, list[Score]] = {}
        self.judged: list[Judged] = []
        self.held_fits: HeldOutFits = {}
        self.verdict: Verdict[Judged]

    def run(self) -> Verdict[Judged]:
        """Return the verdict after all stages; raises IntegrationError if the healthy model cannot follow the blocks."""
        for percent, stage in (
            (5.0, self.fit_healthy),
            (45.0, self.singles),
            (75.0, self.pairs),
            (75.0, self.vary_best),
            (85.0, self.judge),
            (95.0, self.challenge),
        ):
            self.stages.until(percent)
            stage()
        return self.verdict

    def fit_healthy(self) -> None:
        """Fit the healthy model."""
        self.healthy = self.fitter.fit(use=self.training, iterations=8, fine=True)

    def vary_best(self) -> None:
        """Try the best fit's causes in other variants, if it leaves something."""
        best = self.fits.ordered()[:1]
        if best and self.leaves_something(best[0]):
            self.try_variants(best[0])

    def is_within_form(self, fit: FitResult) -> bool:
        """Return whether what a fit leaves, and strains tolerances by, may be the error of a form that is a guess."""
        form, channels = inexact_squares(self.model, fit), misfit(self.model, fit).channels
        strain = float(np.sum(fit.shared[: fit.layout.healthy] ** 2))
        return strain < sum(form.values()) and all(
            item.beyond == 0.0 or item.excess <= form.get(name, 0.0)
            for name, item in channels.items()
        )

    def leaves_something(self, fit: FitResult) -> bool:
        """Return whether a fit leaves more than noise and the error of its form."""
        return misfit(self.model, fit).beyond > 0.0 and not self.is_within_form(fit)

    def judge(self) -> None:
        """Judge the healthy fit and the best ones by the held-out blocks, and decide."""
        best = [
            fit
            for count, most in ((1, 8), (2, 8), (3, 2))
            for fit in self.fits.of_size(count)[:most]
        ]
        judged = judge(
            self.fitter, [self.healthy, *best], self.held_out, self.workers, self.held_fits
        )
        self.judged = [item for item in judged if acceptable(item)]
        self.verdict = decide(self.judged, self.model.size)

    def challenge(self) -> None:
        """Try what may replace the leader: look-alikes, other variants, terms without a form."""
        verdict, leader = self.verdict, self.verdict.leader
        tried = []
        if verdict.claimed:
            tried.append(self.try_alike(leader.training, min(verdict.gains.values())))
            if self.leaves_something(leader.both):  # the held-out blocks may show it alone
                tried.append(self.try_variants(leader.training))
        tried.append(self.try_terms())
        if any(tried):
            self.judge()

    def unseen_beside(self, leader: FitResult) -> list[Score]:
        """Return the scores of further causes beside the leader, or beside one of its causes."""
        names = {leader.name, *(item.name for item in leader.candidates)}
        ids = {item.id for item in leader.candidates}
        scores = next((s for name, s in self.scores_beside.items() if name in names), [])
        return [score for score in scores if score.candidate.id not in ids]

    # --- fits ---------------------------------------------------------------------------------
    def best_start(self, task: Task) -> tuple[float, Floats, Floats] | None:
        """Return cost, shared [shared] and scatter [strokes, scatter], in deviations, of a task's best start; None without any."""
        model = self.model
        healthy = len(model.unit) + len(model.offsets)
        none = (np.zeros(healthy), np.zeros((model.size, len(model.scatter))))
        begins = [none] if task.begin is None else [task.begin, none]
        parameters = [p for item in task.candidates for p in item.parameters]
        best: tuple[float, Floats, Floats] | None = None
        for start in task.starts:
            values = itertools.chain.from_iterable(start)
            scaled = [scaled_of(p, value) for p, value in zip(parameters, values, strict=True)]
            for shared, scatter in begins:
                trial = np.concatenate([shared[:healthy], scaled])
                limit = np.inf if best is None else best[0]
                cost = self.fitter.cost(trial, scatter, task.candidates, self.sample, limit)
                if np.isfinite(cost) and (best is None or cost < best[0]):
                    best = (cost, trial, scatter)
        return best

    def approach(self, task: Task) -> tuple[float, Task] | None:
        """Return the cost that a task's causes alone reach, and the task from there on."""
        best = self.best_start(task)
        if best is None:
            return None
        _cost, shared, scatter = best
        try:
            cost, shared = self.fitter.approach(
                task.candidates, shared, scatter, self.sample, BUDGET.own_iterations
            )
        except IntegrationError as error:
            self.fitter.refusals.lose(task.candidates, error)
            return None
        own = shared[self.model.layout(task.candidates).effect_slice]
        values = self.model.effect_values(task.candidates, own)
        start = tuple(tuple(table.values()) for table in values)
        return cost, replace(task, starts=(start,), begin=(shared, scatter))

    def attempt(self, task: Task) -> FitResult | None:
        """Run one fit from the best of its starts; None if none of them can be simulated."""
        best = self.best_start(task)
        if best is None:
            return None
        cost, start, scatter = best
        is_far = cost > BUDGET.far_cost_per_number * self.sample_size
        first = BUDGET.own_iterations if is_far else 0
        return self.fitter.attempt(
            task.candidates,
            start=start,
            scatter=scatter,
            use=self.sample,
            iterations=task.iterations + first,
            effects_first=first,
            reuse=self.parent_blocks.get(task.parent, {}),
        )

    def refine(self, fit: FitResult, iterations: int = BUDGET.last_iterations) -> FitResult:
        """Continue a fit from its optimum; strokes it did not use get their scatter first."""
        scatter = fit.stroke.copy()
        unused = sorted(set(self.training) - set(fit.use))
        if unused:
            everything = range(len(fit.shared))
            first = self.fitter.fit(
                fit.candidates, start=fit.shared, use=unused, iterations=3, freeze=everything
            )
            scatter[unused] = first.stroke[unused]
        return self.fitter.fit(
            fit.candidates,
            start=fit.shared,
            scatter=scatter,
            use=self.training,
            iterations=iterations,
            fine=iterations > 0,
        )

    def run_tasks(self, tasks: Sequence[Task]) -> list[FitResult]:
        """First fits, side by side, on the sample of the training strokes; best first."""
        fits = Fits()
        for fit in fitted(self.fitter, self.attempt, tasks, self.workers, self.stages):
            fits.add(fit)
        return fits.ordered()

    def polish(self, fits: Sequence[FitResult], again: bool = True) -> None:
        """Fit all training strokes from the first fits; store the better ones."""
        most = BUDGET.last_iterations if again else BUDGET.valley_iterations

        def work(fit: FitResult) -> FitResult | None:
            try:
                return self.refine(fit, most).light()
            except IntegrationError as error:
                self.fitter.refusals.lose(fit.candidates, error)
                return None

        for fit in fitted(self.fitter, work, fits, self.workers):
            self.fits.add(fit)
        best = self.fits.ordered()[:1]
        if again and best and best[0].iterations >= BUDGET.last_iterations:
            self.polish(best, False)  # a long valley

    # --- stages -------------------------------------------------------------------------------
    def singles(self) -> None:
        """Fit every cause alone: all of them if the healthy fit is far off, else those that score.

        Linear scores say nothing either of what wide scatter imitates by moving edges in time; and a
        tolerance at its bound is in the way of the cause that does the same: then that begins anew.
        """
        healthy, chosen, is_strained = self.healthy, self.candidates, strained(self.healthy)
        per_number = misfit(self.model, healthy).per_number
        if per_number < BUDGET.linear_excess_per_number and not is_strained:
            self.parent_blocks[healthy.name] = healthy.blocks
            self.scores = screen(self.fitter, healthy, self.candidates)
            likely = [s.candidate for s in self.scores if s.gain > BUDGET.min_linear_gain]
            chosen = likely[: 2 * BUDGET.singles]
        is_bound = is_strained or bool(np.any(np.abs(healthy.shared) >= FARTHEST_SD))
        tasks = []
        for item in chosen:
            tasks.append(Task.beside(healthy, item, item.starts, parent=healthy.name))
            if item.effect.rugged or (item.effect.tolerance and is_bound):
                tasks += [Task((item,), ((start,),)) for start in item.starts]
        self.first = self.run_tasks(self.hopeful(tasks, BUDGET.approached))
        self.polish(_promising(self.first, BUDGET.singles))

    def hopeful(self, tasks: list[Task], least: int) -> list[Task]:
        """Return at least so many tasks, those worth a whole fit, by what their causes alone reach."""
        if len(tasks) <= least:
            return tasks
        reached = [r for r in fitted(self.fitter, self.approach, tasks, self.workers) if r]
        reached.sort(key=lambda item: item[0])
        return [
            task
            for k, (cost, task) in enumerate(reached)
            if k < least or cost < BUDGET.max_approached_ratio * reached[0][0]
        ]

    def pairs(self) -> None:
        """Try a second cause on top of the best singles, by score; then finish the best pairs."""
        tasks: list[Task] = []
        parents = _one_of_each(self.fits.of_size(1))[: BUDGET.parents]
        for parent, scores in fitted(self.fitter, self.scored, parents, self.workers):
            self.parent_blocks[parent.name] = parent.blocks
            self.scores_beside[parent.name] = scores
            likely = [s for s in scores if s.gain > BUDGET.min_linear_gain][: BUDGET.children]
            tasks += [_pair_task(parent, score) for score in likely]
        unique: dict[frozenset[str], Task] = {}
        # beside a cause that leaves no more than the error of its form, no other one can gain enough
        settled = {fit.name for fit in parents if self.is_within_form(fit)}
        for task in tasks + self.crossed():
            names = frozenset(item.name for item in task.candidates)
            if not names & settled:
                unique.setdefault(names, task)
        self.polish(_promising(self.run_tasks(list(unique.values())), BUDGET.pairs))

    def crossed(self) -> list[Task]:
        """Pairs of the best singles: while much is unexplained, linear scores mislead."""
        best = self.fits.of_size(1)
        if not best or not self.leaves_something(best[0]):
            return []
        singles = _one_of_each(self.first)
        least = [BUDGET.outstanding_ratio * fit.cost for fit in singles[:1]]
        outstanding = len(singles) > 1 and least[0] < singles[1].cost
        tasks = []
        for one, two in itertools.combinations(singles[: BUDGET.crossed], 2):
            other = two.candidates[0]
            if compatible(other, one.candidates) and (one is singles[0] or not outstanding):
                tasks.append(Task.beside(one, other, (*two.point, *other.starts[:4])))
        return tasks

    def try_variants(self, best: FitResult) -> bool:
        """Try a hypothesis with each of its causes in its other variants; True if any was tried.

        What is added to a large cause is easily mistaken for another one of its class: the causes of
        a pair are replaced by those too.
        """
        if best.name in self.varied:
            return False
        self.varied.add(best.name)
        tasks = []
        for index, (member, values) in enumerate(zip(best.candidates, best.values, strict=True)):
            before, after = best.candidates[:index], best.candidates[index + 1 :]
            for other in self.candidates:
                starts: Starts = ()
                if other.id == member.id:
                    starts = (tuple(values.get(p.name, p.neutral) for p in other.parameters),)
                elif len(best.candidates) > 1 and other.cause_class == member.cause_class:
                    starts = other.starts
                if starts and other.name != member.name and compatible(other, (*before, *after)):
                    ends = best.point[:index], best.point[index + 1 :]
                    points = tuple((*ends[0], start, *ends[1]) for start in starts)
                    tasks.append(Task((*before, other, *after), points, (best.shared, best.stroke)))
        self.polish(self.run_tasks(tasks)[:1])
        return bool(tasks)

    def try_alike(self, leader: FitResult, gain: float) -> bool:
        """Fit what the leader's covariance cannot distinguish from its one cause; True if there is any.

        gain: of that cause, in log evidence; another one of which the leader imitates so much that
        less than `alike_evidence` of it would remain is a rival, if it fits.
        """
        before = {score.candidate.name: score.free for score in self.scores}
        if len(leader.candidates) != 1 or not before:
            return False
        tasks = [
            Task((score.candidate,), tuple((start,) for start in score.candidate.starts), None, 6)
            for score in self.scored(leader)[1]
            if gain * score.free < BUDGET.alike_evidence * before.get(score.candidate.name, 0.0)
            and score.candidate.name not in self.fits
        ]
        self.polish(self.run_tasks(tasks))
        return bool(tasks)

    def try_terms(self) -> bool:
        """Fit terms without a form alone and with the best single; True if any was tried.

        Only if the best hypothesis leaves more than the band of clean blocks and a detail, or owes its
        agreement to scatter that healthy blocks do not have; not for the error of its form.
        """
        best = min(self.judged, key=lambda item: item.score)
        excess = max(1.0, self.verdict.healthy.whole.excess)
        detail = BUDGET.max_unexplained_share * excess + best.whole.detail
        is_small = best.whole.beyond <= detail and not strained(best.training)
        if is_small or self.is_within_form(best.both):
            return False
        better = [fit for fit in self.fits.of_size(1)[:1] if fit.cost < 0.5 * self.healthy.cost]
        tasks = [
            Task.beside(parent, item, item.starts, iterations=BUDGET.term_iterations)
            for item in self.terms
            for parent in (self.healthy, *better)
            if compatible(item, parent.candidates)
        ]
        self.polish(self.run_tasks(self.hopeful(tasks, BUDGET.terms))[: BUDGET.terms])
        return bool(tasks)

    def scored(self, parent: FitResult) -> tuple[FitResult, list[Score]]:
        """Return a single on all training strokes, and the scores of every compatible candidate."""
        full = self.refine(parent, 0)
        others = [c for c in self.candidates if compatible(c, parent.candidates)]
        return full, screen(self.fitter, full, others)


def _pair_task(parent: FitResult, score: Score) -> Task:
    """Return the fit of a pair, beginning at the single's optimum and the score's amount."""
    starts = [score.start]
    first = score.candidate.parameters[0]
    value = first.neutral + score.amount * (score.start[0] - first.neutral)
    if first.low <= value <= first.high:
        starts.append((value, *score.start[1:]))
    iterations = BUDGET.first_iterations + 1
    return Task.beside(parent, score.candidate, starts, iterations=iterations, parent=parent.name)


def _one_of_each(singles: Sequence[FitResult]) -> list[FitResult]:
    """Return the first fit of each identifier."""
    firsts: dict[str, FitResult] = {}
    for fit in singles:
        firsts.setdefault(fit.candidates[0].id, fit)
    return list(firsts.values())


def _promising(fits: Sequence[FitResult], most: int) -> list[FitResult]:
    """Fits worth finishing: the best, and others whose cost is not hopelessly larger."""
    limits = [BUDGET.max_cost_ratio * fit.cost for fit in fits[:1]]
    first, others = fits[: BUDGET.always_finished], fits[BUDGET.always_finished : most]
    return [*first, *(fit for fit in others if fit.cost < limits[0])]


def _sample_of(model: Problem, training: Sequence[int]) -> tuple[int, ...]:
    """Return a few training strokes for first fits: each stratum in turn, at most `sample_blocks`."""
    ranks: Counter[Hashable] = Counter()
    ranked = []
    for k in training:
        key = model.stratum(k)
        ranked.append((ranks[key], k))
        ranks[key] += 1
    return tuple(sorted(k for _rank, k in sorted(ranked)[: BUDGET.sample_blocks]))
