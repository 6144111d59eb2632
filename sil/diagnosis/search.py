"""Search over hypotheses: the healthy plant, every single cause, pairs of the promising ones.

Everything here uses the training strokes alone; the held-out strokes judge afterwards.
Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plant.errors import IntegrationError
from sil.diagnosis.screening import Score, screen
from sil.diagnosis.split import stratum
from sil.diagnosis.workers import Show, Stages, no_progress, spread_out
from sil.fitting.fit import FitResult, Fitter
from sil.fitting.floor import misfit, strained
from sil.fitting.hypotheses import Candidate, compatible, scaled_of
from sil.fitting.model import Block, CampaignModel

Floats = NDArray[np.float64]

WORTH = 12.0
"""Linear gain in cost below which a further effect is not even tried."""

FIRST_ITERATIONS = 3
LAST_ITERATIONS = 10
MOST_ITERATIONS = 30
SINGLES_KEPT = 6
PAIRS_KEPT = 5
FEWEST = 3
HOPELESS = 6.0
"""A first fit whose cost is larger than the best one's by this factor is not finished."""

SAMPLE = 8
NEAR = 1.0
"""Excess of chi squared per number below which the healthy fit's linear scores can be trusted."""
PARENTS = 3
CROSSED = 7
"""So many of the best singles are tried in pairs with each other."""
OUTSTANDING = 50.0
"""A single whose cost is smaller by this factor than any other's is part of every pair tried."""
FAR = 3.0
"""Cost per number above which a fit begins with the hypothesis' own parameters alone ..."""
EFFECTS_FIRST = 3
"""... for so many iterations."""
CHILDREN = 3


@dataclass(frozen=True)
class Task:
    """One fit to run: candidates, where each begins, and the healthy part's beginning.

    parent: the fit whose derivatives by tolerances serve, if it is near enough.
    """

    candidates: tuple[Candidate, ...]
    starts: tuple[tuple[tuple[float, ...], ...], ...]
    begin: tuple[Floats, Floats] | None
    iterations: int
    parent: str = ""


@dataclass
class Found:
    """Result of a search: fits by name (on the training strokes), the healthy one among them."""

    healthy: FitResult
    fits: dict[str, FitResult] = field(default_factory=dict)

    def ordered(self) -> list[FitResult]:
        """All fits, best evidence first."""
        return sorted(self.fits.values(), key=lambda fit: fit.evidence())

    def of_size(self, count: int) -> list[FitResult]:
        """Fits of that many causes, best first."""
        return [fit for fit in self.ordered() if len(fit.candidates) == count]


class Search:
    """Fits hypotheses to the training strokes of a campaign."""

    def __init__(
        self,
        model: CampaignModel,
        candidates: Sequence[Candidate],
        training: Sequence[int],
        workers: int = 1,
        progress: Show = no_progress,
    ) -> None:
        self.model = model
        self.fitter = Fitter(model)
        self.candidates = list(candidates)
        self.training = tuple(training)
        self.sample = sample_of(model, self.training)
        self.sample_size = sum(len(model.measured(k)) for k in self.sample)
        self.workers = workers
        self.stages = Stages(progress)
        self.stages.until(5.0)
        self.first: list[FitResult] = []
        self.known: dict[str, dict[int, Block]] = {}

    def run(self) -> Found:
        """Fit the healthy model, singles and pairs, and return them."""
        healthy = self.fitter.fit(use=self.training, iterations=8, fine=True)
        found = Found(healthy)
        self.stages.until(45.0)
        self.singles(found)
        self.stages.until(75.0)
        self.pairs(found)
        self.variants(found)
        return found

    # --- fits ---------------------------------------------------------------------------------
    def begin_scaled(self, candidates: Sequence[Candidate], starts) -> Floats:  # type: ignore[no-untyped-def]
        """Return starts in typical sizes from neutral.

        Result [parameters], no unit.
        """
        return np.array(
            [
                scaled_of(p, value)
                for item, start in zip(candidates, starts, strict=True)
                for p, value in zip(item.parameters, start, strict=True)
            ]
        )

    def attempt(self, task: Task) -> FitResult | None:
        """Run one fit from the best of its starts; None if none of them can be simulated."""
        model = self.model
        healthy = len(model.unit) + len(model.offsets)
        none = (np.zeros(healthy), np.zeros((len(model.strokes), len(model.scatter))))
        begins = [none] if task.begin is None else [task.begin, none]
        best: tuple[float, Floats, Floats] | None = None
        for starts in task.starts:
            scaled = self.begin_scaled(task.candidates, starts)
            for shared, scatter in begins:
                trial = np.concatenate([shared[:healthy], scaled])
                limit = np.inf if best is None else best[0]
                cost = self.fitter.cost(trial, scatter, task.candidates, self.sample, limit)
                if np.isfinite(cost) and (best is None or cost < best[0]):
                    best = (cost, trial, scatter)
        if best is None:
            return None
        first = EFFECTS_FIRST if best[0] > FAR * self.sample_size else 0
        try:
            fit = self.fitter.fit(
                task.candidates,
                start=best[1],
                scatter=best[2],
                use=self.sample,
                iterations=task.iterations + first,
                effects_first=first,
                reuse=self.known.get(task.parent, {}),
            )
        except IntegrationError:
            return None
        return fit.light()

    def refine(self, fit: FitResult, iterations: int = LAST_ITERATIONS) -> FitResult:
        """Continue a fit from its optimum; strokes it did not use get their scatter first."""
        scatter = fit.stroke.copy()
        unseen = tuple(sorted(set(self.training) - set(fit.use)))
        if unseen:
            first = self.fitter.fit(
                fit.candidates,
                start=fit.shared,
                use=unseen,
                iterations=3,
                freeze=range(len(fit.shared)),
            )
            scatter[list(unseen)] = first.stroke[list(unseen)]
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
        done: dict[str, FitResult] = {}
        for fit in spread_out(self.attempt, tasks, self.workers, self.stages):
            if fit is not None and (fit.name not in done or fit.cost < done[fit.name].cost):
                done[fit.name] = fit
        return sorted(done.values(), key=lambda fit: fit.evidence())

    def polish(self, found: Found, fits: Sequence[FitResult], again: bool = True) -> None:
        """Fit all training strokes from the first fits; store the better ones by name."""
        most = LAST_ITERATIONS if again else MOST_ITERATIONS

        def work(fit: FitResult) -> FitResult | None:
            try:
                return self.refine(fit, most).light()
            except IntegrationError:
                return None

        for fit in spread_out(work, fits, self.workers):
            if fit is None:
                continue
            held = found.fits.get(fit.name)
            if held is None or fit.cost < held.cost:
                found.fits[fit.name] = fit
        best = found.ordered()[:1]
        if again and best and best[0].iterations >= LAST_ITERATIONS:
            self.polish(found, best, False)  # a long valley

    # --- stages -------------------------------------------------------------------------------
    def singles(self, found: Found) -> None:
        """Fit every cause alone: all of them if the healthy fit is far off, else those that score.

        Linear scores say nothing either of what wide scatter imitates by moving edges in time.
        """
        healthy = found.healthy
        chosen: list[Candidate] = self.candidates
        if misfit(self.model, healthy).per_number < NEAR and not strained(healthy):
            self.known[healthy.name] = healthy.blocks
            scores = screen(self.model, healthy, self.candidates)
            chosen = [s.candidate for s in scores if s.gain > WORTH][: 2 * SINGLES_KEPT]
        begin = (healthy.shared, healthy.stroke)
        tasks = [
            Task((item,), tuple((s,) for s in item.starts), begin, FIRST_ITERATIONS, healthy.name)
            for item in chosen
        ]
        tasks += [
            Task((item,), ((start,),), None, FIRST_ITERATIONS)
            for item in chosen
            if item.effect.rugged
            for start in item.starts
        ]
        self.first = self.run_tasks(tasks)
        self.polish(found, promising(self.first, SINGLES_KEPT))

    def pairs(self, found: Found) -> None:
        """Try a second cause on top of the best singles, by score; then finish the best pairs."""
        tasks: dict[str, Task] = {}
        for parent, scores in spread_out(self.scored, self.parents(found), self.workers):
            self.known[parent.name] = parent.blocks
            for score in scores[:CHILDREN]:
                task = self.pair_task(parent, score)
                key = "+".join(sorted(item.name for item in task.candidates))
                tasks.setdefault(key, task)
        for task in self.crossed(found):
            key = "+".join(sorted(item.name for item in task.candidates))
            tasks.setdefault(key, task)
        self.polish(found, promising(self.run_tasks(list(tasks.values())), PAIRS_KEPT))

    def crossed(self, found: Found) -> list[Task]:
        """Pairs of the best singles: while much is unexplained, linear scores mislead."""
        best = found.of_size(1)
        if not best or misfit(self.model, best[0]).beyond == 0.0:
            return []
        singles: list[FitResult] = []
        for fit in self.first:
            if all(fit.candidates[0].id != other.candidates[0].id for other in singles):
                singles.append(fit)
        tasks = []
        outstanding = len(singles) > 1 and OUTSTANDING * singles[0].cost < singles[1].cost
        for one, two in itertools.combinations(singles[:CROSSED], 2):
            if outstanding and one is not singles[0]:
                continue
            if not compatible(two.candidates[0], one.candidates):
                continue
            mine, theirs = (
                tuple(fit.values[0][p.name] for p in fit.candidates[0].parameters)
                for fit in (one, two)
            )
            starts = [(mine, theirs)]
            starts += [(mine, start) for start in two.candidates[0].starts[:4]]
            tasks.append(
                Task(
                    (*one.candidates, *two.candidates),
                    tuple(starts),
                    (one.shared, one.stroke),
                    FIRST_ITERATIONS,
                )
            )
        return tasks

    def variants(self, found: Found) -> None:
        """Try the best hypothesis with each of its causes in its other variants."""
        fits = found.ordered()
        if not fits or misfit(self.model, fits[0]).beyond == 0.0:
            return
        best = fits[0]
        tasks = []
        for index, member in enumerate(best.candidates):
            for other in self.candidates:
                if other.id != member.id or other.name == member.name:
                    continue
                members = list(best.candidates)
                members[index] = other
                own = tuple(
                    tuple(table[p.name] for p in item.parameters)
                    for item, table in zip(members, best.values, strict=True)
                )
                begin = (best.shared, best.stroke)
                tasks.append(Task(tuple(members), (own,), begin, FIRST_ITERATIONS))
        self.polish(found, self.run_tasks(tasks)[:1])

    def parents(self, found: Found) -> list[FitResult]:
        """Singles that a second cause may be added to: the best ones, one for each identifier."""
        chosen: list[FitResult] = []
        counts: set[str] = set()
        for fit in found.of_size(1):
            if fit.candidates[0].id not in counts and len(chosen) < PARENTS:
                chosen.append(fit)
                counts.add(fit.candidates[0].id)
        return chosen

    def scored(self, parent: FitResult) -> tuple[FitResult, list[Score]]:
        """Scores of every compatible candidate on top of a single."""
        full = self.refine(parent, 0)
        others = [c for c in self.candidates if compatible(c, parent.candidates)]
        return full, [s for s in screen(self.model, full, others) if s.gain > WORTH]

    def pair_task(self, parent: FitResult, score: Score) -> Task:
        """Return the fit of a pair, beginning at the single's optimum and the score's amount."""
        own = tuple(parent.values[0][p.name] for p in parent.candidates[0].parameters)
        starts = [(own, score.start)]
        first = score.candidate.parameters[0]
        value = first.neutral + score.amount * (score.start[0] - first.neutral)
        if first.low <= value <= first.high:
            starts.append((own, (value, *score.start[1:])))
        return Task(
            (parent.candidates[0], score.candidate),
            tuple(starts),
            (parent.shared, parent.stroke),
            FIRST_ITERATIONS + 1,
            parent.name,
        )


def promising(fits: Sequence[FitResult], most: int) -> list[FitResult]:
    """Fits worth finishing: the FEWEST best, and others whose cost is not hopelessly larger."""
    if not fits:
        return []
    limit = HOPELESS * fits[0].cost
    return [fit for k, fit in enumerate(fits[:most]) if k < FEWEST or fit.cost < limit]


def sample_of(model: CampaignModel, training: Sequence[int]) -> tuple[int, ...]:
    """Return a few training strokes for first fits: each stratum in turn, at most SAMPLE."""
    counts: dict[tuple[str, str, bool], int] = {}
    ranked = []
    for k in training:
        key = stratum(model.strokes[k])
        counts[key] = counts.get(key, -1) + 1
        ranked.append((counts[key], k))
    return tuple(sorted(k for _rank, k in sorted(ranked)[:SAMPLE]))
