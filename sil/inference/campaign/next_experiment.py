"""The strokes to measure next: those from which most is to be learned about what is still open.

What is open are questions, each a few hypotheses with probabilities: the rivals of a verdict; the
named cause and the next best explanation; or, where nothing is claimed, a healthy unit and one with
a cause that these strokes would not have shown. A stroke is worth what it is expected to add to
the log evidence of a hypothesis that is true over another one,

    d = 1/2 (r' W r - g' M^-1 g),  W = (1 + B B')^-1,  g = J' W r,  M = P + J' W J,

r being the difference of the two predictions once the false one's own scatter of this stroke is
fitted (its prior counts in r'r), B the derivatives by that scatter, J those by all else that it may
move to follow, and P what the strokes measured so far say of those. Sums over strokes of
[J r]'W[J r] give d of them together. From d follows the expected information on a question, by the
estimate for mixtures of Kolchinsky and Tracey (Entropy 19, 2017, 361); strokes are added one by one
where it grows most, an idea of Box and Hill (Technometrics 9, 1967, 57-71).
Assumed: predictions are linear within what is still uncertain of a unit, and a true hypothesis has
its fitted parameters.
Checked by: tests/unit/sil/inference/campaign/test_next_experiment.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from plant.errors import IntegrationError
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, CampaignStroke, Floats
from sil.files.quantity import counted
from sil.inference.campaign.designs import described, designs, imagined
from sil.inference.campaign.model import CampaignModel
from sil.inference.campaign.observations import StrokeObservation
from sil.inference.candidate import Candidate, scaled_of
from sil.inference.fit import FitResult, Fitter
from sil.inference.thresholds import LIMITS
from sil.inference.verdict import Judged, Verdict
from sil.inference.workers import spread_out

MOST = 12
"""Strokes that are proposed at most."""


@dataclass(frozen=True)
class HypothesisInformation:
    """What may be true: causes, shared parameters [shared], and the information on them so far."""

    name: str
    candidates: tuple[Candidate, ...]
    shared: Floats
    normal: Floats

    @classmethod
    def of(cls, fit: FitResult) -> HypothesisInformation:
        """Return the hypothesis of a fit."""
        return cls(fit.name, fit.candidates, fit.shared, fit.normal)


@dataclass(frozen=True)
class Question:
    """Hypotheses by number with their probabilities, the pairs (true, false) to tell apart, and what is enough."""

    hypotheses: tuple[int, ...]
    probabilities: Floats
    pairs: tuple[tuple[int, int], ...]
    enough: float = LIMITS.min_gain


@dataclass(frozen=True)
class Proposed:
    """One stroke to measure: the pair (true, false) that it alone tells apart best, and the log evidence expected."""

    entry: CampaignStroke
    pair: tuple[str, str]
    distance: float


@dataclass(frozen=True)
class NextExperiment:
    """The strokes to measure, the first one the most telling, and how well they separate together.

    together: expected log evidence of all of them by (true, false); shown, predicted: the first one
    as it would be observed, and what the pair that it tells apart best predicts [n], standardised.
    """

    strokes: tuple[Proposed, ...]
    separates: tuple[str, ...]
    together: dict[tuple[str, str], float]
    shown: StrokeObservation
    predicted: dict[str, Floats]
    enough: float
    purpose: str

    def __iter__(self) -> Iterator[tuple[int, Proposed]]:
        """Yield strokes that are not alike, and how often each is to be measured."""
        counts = Counter(item.entry.conditions for item in self.strokes)
        for item in self.strokes:
            if count := counts.pop(item.entry.conditions, 0):
                yield count, item

    @property
    def entries(self) -> list[CampaignStroke]:
        """The strokes as a campaign has them."""
        return [item.entry for item in self.strokes]

    @property
    def separated(self) -> bool:
        """Whether every pair is expected to be told apart."""
        return min(self.together.values()) >= self.enough

    @property
    def why(self) -> str:
        """One sentence: what the strokes are for and what is expected of them."""
        separated = sum(d >= self.enough for d in self.together.values())
        if self.separated:
            expected = "expected to be enough"
        elif len(self.together) > 2:
            expected = f"expected to show {separated} of {len(self.together)}"
        else:
            one, two = min(self.together, key=lambda pair: self.together[pair])
            share = self.together[one, two] / self.enough
            expected = f"{share:.0%} of what tells {one} from {two}"
        return f"{self.purpose}: {counted(len(self.strokes), 'stroke')}, {expected}"

    def as_json(self) -> dict[str, Any]:
        """Return the object in diagnosis.json: the first stroke's conditions, then all strokes."""
        first = self.strokes[0]
        c = first.entry.conditions
        conditions = {
            "kind": c.kind,
            "supply_pressure_pa": c.supply_pressure_pa,
            "load": c.load,
            "rest_s": c.rest_s,
            "charged_before": list(c.charged_before),
            "commands": [list(item) for item in c.commands],
            "repeats": next(iter(self))[0],
        }
        strokes = [
            {
                "file": item.entry.file,
                "label": item.entry.label,
                "true": item.pair[0],
                "false": item.pair[1],
                "expected_distance": item.distance,
            }
            for item in self.strokes
        ]
        return {
            "conditions": conditions,
            "separates": list(self.separates),
            "expected_distance": first.distance,
            "why": self.why,
            "enough": self.enough,
            "strokes": strokes,
            "together": [
                {"true": one, "false": two, "expected_distance": d}
                for (one, two), d in self.together.items()
            ],
        }


def next_experiment(
    model: CampaignModel,
    parameters: ParameterSet,
    campaign: Campaign,
    verdict: Verdict[Judged],
    judged: Sequence[Judged],
    causes: Sequence[Candidate] = (),
    *,
    confirm: bool = False,
    workers: int = 1,
) -> NextExperiment | None:
    """Return the strokes to measure next; None if nothing is open, or no stroke of the rig tells more.

    causes: if nothing is claimed, those of which some may be hidden; confirm: ask also whether a
    cause without rivals is the next best explanation after all.
    """
    if verdict.rivals or (verdict.claimed and confirm):
        hypotheses, questions = _between(verdict, judged)
        first, *others = (item.name for item in hypotheses)
        what = "separate" if verdict.rivals else "check"
        purpose = f"to {what} {first} from {' and '.join(others)}"
    elif not verdict.claimed and causes:
        healthy = HypothesisInformation.of(verdict.healthy.training)
        enough = LIMITS.needed_gain(len(model.strokes) + MOST)
        hidden: list[HypothesisInformation] = []
        for size in (1.0, 0.25):  # typical sizes; the smaller one if all are shown at the larger
            hidden = hidden or _hidden(model, healthy, causes, size, enough, workers)
        hypotheses = [healthy, *hidden]
        questions = [_whether(k, enough) for k in range(1, len(hypotheses))]
        purpose = f"to show {counted(len(hidden), 'cause')} that would not have been noticed"
    else:
        return None
    if not questions:
        return None
    terms = any(candidate.is_term for item in hypotheses for candidate in item.candidates)
    entries = designs(model.strokes, "next", every_rest=terms)
    strokes = imagined(entries, model.strokes, parameters, campaign.sample_rate_hz)
    wider = CampaignModel([*model.strokes, *strokes], model.spread)
    moved = [_moved(wider, model, item) for item in hypotheses]
    picked, alone, together = _chosen(wider, len(model.strokes), moved, questions, workers)
    if not picked:
        return None
    proposed = []
    for number, k in enumerate(picked, start=1):
        conditions = wider.strokes[k].conditions
        entry = CampaignStroke(f"stroke_{number:03d}.csv", described(conditions), conditions)
        best = max(alone[k], key=lambda pair: alone[k][pair])
        pair = moved[best[0]].name, moved[best[1]].name
        proposed.append(Proposed(entry, pair, alone[k][best]))
    of_pair = [item for item in moved if item.name in proposed[0].pair]
    return NextExperiment(
        tuple(proposed),
        tuple(item.name for item in moved),
        {(moved[i].name, moved[j].name): d for (i, j), d in together.items()},
        wider.strokes[picked[0]],
        {item.name: _predicted(wider, picked[0], item) for item in of_pair},
        questions[0].enough,
        purpose,
    )


def _between(
    verdict: Verdict[Judged], judged: Sequence[Judged]
) -> tuple[list[HypothesisInformation], list[Question]]:
    """Return the leading explanations, and the question which of them is true, if there are two."""
    leader = verdict.leader
    asked = {name for group in verdict.rivals for name in group}
    explanations = {leader.name: leader}
    for item in sorted(judged, key=lambda item: item.score):
        if not item.ids or set(item.ids) >= set(leader.ids) or len(explanations) == 4:
            continue
        if verdict.rivals:
            likely = item.probability >= LIMITS.min_contest_share * leader.probability
            is_open = likely and not asked.isdisjoint(item.ids)
        else:  # the next best one, whatever its probability
            is_open = len(explanations) < 2
        if is_open:
            explanations.setdefault(item.name, item)
    items = list(explanations.values())
    hypotheses = [HypothesisInformation.of(item.training) for item in items]
    if len(items) < 2:
        return hypotheses, []
    weights = np.array([item.probability if verdict.rivals else 1.0 for item in items])
    numbers = tuple(range(len(items)))
    causes = [set(item.ids) for item in items]
    # forms of one cause need not be told apart
    pairs = tuple((i, j) for i, j in permutations(numbers, 2) if causes[i] != causes[j])
    return hypotheses, [Question(numbers, weights / weights.sum(), pairs)]


def _whether(cause: int, enough: float) -> Question:
    """Return the question whether a cause acts in a unit that is healthy otherwise: hypothesis 0."""
    return Question((cause, 0), np.array([0.5, 0.5]), ((cause, 0),), enough)


def _hidden(
    model: CampaignModel,
    healthy: HypothesisInformation,
    candidates: Sequence[Candidate],
    size: float,
    enough: float,
    workers: int,
) -> list[HypothesisInformation]:
    """Return the healthy unit with each cause that the strokes measured would not show at that size."""
    fitter = Fitter(CampaignModel(model.strokes, model.spread))
    with_cause = [healthy_with(healthy, candidate, size) for candidate in candidates]

    def shown(item: HypothesisInformation) -> float:
        sums = {(1, 0): np.pad(np.eye(len(healthy.shared)), (0, 1))}
        for k in range(len(model.strokes)):
            more = separation_by(fitter, k, [healthy, item], [_whether(1, enough)])
            sums = sums if more is None else added(sums, more)
        return distances_of(sums)[1, 0]

    distances = spread_out(shown, with_cause, workers)
    return [item for item, d in zip(with_cause, distances, strict=True) if d < enough]


def healthy_with(
    healthy: HypothesisInformation, candidate: Candidate, size: float
) -> HypothesisInformation:
    """Return the healthy unit with a cause, at the start of its fits that is next to `size`, in typical ones."""
    main = candidate.parameters[0]

    def ratio(start: tuple[float, ...]) -> float:
        return float(abs(np.log(max(abs(scaled_of(main, start[0])), 1e-9) / size)))

    start = min(candidate.starts, key=ratio)
    pairs = zip(candidate.parameters, start, strict=True)
    own = np.array([scaled_of(parameter, value) for parameter, value in pairs])
    name = f"{candidate.name} ({main.name} {start[0]:.3g} {main.unit})".replace(" -)", ")")
    shared = np.concatenate([healthy.shared, own])
    return HypothesisInformation(name, (candidate,), shared, healthy.normal)


Distances = dict[tuple[int, int], float]
"""Expected log evidence by (true, false), hypotheses by number."""


# --- what a stroke tells ------------------------------------------------------------------------
Sums = dict[tuple[int, int], Floats]
"""Sums over strokes by pair (true, false): [J r]' W [J r], with the information P on J's parameters."""


def added(one: Sums, other: Sums) -> Sums:
    """Return the sums over the strokes of both."""
    return {pair: values + other[pair] for pair, values in one.items()}


def distances_of(sums: Sums) -> Distances:
    """Return the expected log evidence of each pair."""
    return {
        pair: 0.5 * float(s[-1, -1] - s[-1, :-1] @ np.linalg.solve(s[:-1, :-1], s[:-1, -1]))
        for pair, s in sums.items()
    }


def information(question: Question, distances: Distances) -> float:
    """Return the expected information on a question, 0 to the entropy of its probabilities, from log evidence by (true, false)."""
    scale = 3.0 / question.enough  # if the equations were exact, 3 would be enough
    total = 0.0
    for i, p in zip(question.hypotheses, question.probabilities, strict=True):
        mixture = 0.0
        for j, q in zip(question.hypotheses, question.probabilities, strict=True):
            d = 0.0 if i == j else distances.get((i, j), distances.get((j, i), 0.0))
            mixture += q * np.exp(-scale * d)
        total -= p * np.log(mixture)
    return float(total)


def separation_by(
    fitter: Fitter,
    k: int,
    hypotheses: Sequence[HypothesisInformation],
    questions: Sequence[Question],
) -> Sums | None:
    """Return what stroke k would tell, its own scatter fitted; None if a hypothesis cannot simulate it."""
    model = fitter.model
    assert isinstance(model, CampaignModel)
    sums: Sums = {}
    with suppress(IntegrationError):
        for i, j in dict.fromkeys(pair for question in questions for pair in question.pairs):
            false = hypotheses[j]
            model.measure(k, _predicted(model, k, hypotheses[i]))
            everything = range(len(false.shared))
            fit = fitter.fit(
                false.candidates, start=false.shared, use=[k], iterations=6, freeze=everything
            )
            spread = fit.stroke[k]
            block = model.linearise(k, false.shared, spread, false.candidates)
            rows = np.column_stack([block.shared, block.residual])
            prior = np.zeros((len(spread), rows.shape[1]))
            prior[:, -1] = -spread
            rows = np.vstack([rows, prior])
            scatter = np.vstack([block.scatter, np.eye(len(spread))])
            cross = scatter.T @ rows
            sums[i, j] = rows.T @ rows - cross.T @ np.linalg.solve(scatter.T @ scatter, cross)
        return sums
    return None


def _predicted(model: CampaignModel, k: int, item: HypothesisInformation) -> Floats:
    """Return the compared numbers [n] of stroke k under a hypothesis, offsets included."""
    setup, states = model.here(k, item.shared, np.zeros(len(model.scatter)), item.candidates)
    first = len(model.unit)
    offsets = item.shared[first : first + len(model.offsets)]
    return model.numbers_of(k, setup, states, rounded=True) + model.offset_columns[k] @ offsets


def _moved(
    model: CampaignModel, old: CampaignModel, item: HypothesisInformation
) -> HypothesisInformation:
    """Return a hypothesis among the parameters of another model, new offsets at their prior."""
    names = [*model.unit, *model.offsets]
    size = len(model.layout(item.candidates).names)
    at = [names.index(name) for name in (*old.unit, *old.offsets)] + list(range(len(names), size))
    shared, normal = np.zeros(size), np.eye(size)
    shared[at] = item.shared
    rows = at[: len(item.normal)]
    normal[np.ix_(rows, rows)] = item.normal
    return HypothesisInformation(item.name, item.candidates, shared, normal)


def _chosen(
    model: CampaignModel,
    measured: int,
    hypotheses: Sequence[HypothesisInformation],
    questions: Sequence[Question],
    workers: int,
) -> tuple[list[int], dict[int, Distances], Distances]:
    """Return the strokes chosen, alike ones together, but not of the first `measured`; what each tells alone, and together."""
    fitter = Fitter(model)
    numbers = range(measured, len(model.strokes))
    separations = spread_out(
        lambda k: separation_by(fitter, k, hypotheses, questions), numbers, workers
    )
    choices = {k: item for k, item in zip(numbers, separations, strict=True) if item is not None}
    if not choices:
        return [], {}, {}
    nothing = sums = {
        (i, j): np.pad(hypotheses[j].normal, (0, 1)) for i, j in next(iter(choices.values()))
    }

    def value(reached: Sums) -> float:
        distances = distances_of(reached)
        return sum(information(question, distances) for question in questions)

    picked: list[int] = []
    most = sum(float(-q.probabilities @ np.log(q.probabilities)) for q in questions)
    while len(picked) < MOST:
        best = max(choices, key=lambda k: value(added(sums, choices[k])))
        if value(added(sums, choices[best])) - value(sums) < 0.01 * most:
            if len(picked) != 1:  # one to fit, and one to judge the fit by
                break
            best = picked[0]
        picked.append(best)
        sums = added(sums, choices[best])
        enough = all(d >= questions[0].enough for d in distances_of(sums).values())
        if enough and len(picked) >= 2:
            break
    picked = sorted(picked, key=picked.index)
    alone = {k: distances_of(added(nothing, choices[k])) for k in picked}
    return picked, alone, distances_of(sums)
