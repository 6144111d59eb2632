"""The diagnosis next to other ways of finding a cause, on the same drawn campaigns.

All see the same strokes, healthy model, catalogue and noise. BIC selection: fits of every cause, added
forward and removed backward, the score chi squared + parameters times log of the sample. Sparse
regression: sequential thresholded least squares of the healthy residual on the linear response to
every cause. Classifier: a network of one hidden layer, trained for each campaign's own strokes on virtual
campaigns, about as many simulations as the diagnosis takes. $OPC4_STUDY names the folder (runs/rivals), where
what was found is stored line by line; $OPC4_STUDY_CAMPAIGNS how many (24), every third of them clean, $OPC4_FIRST the first (0).
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from plant.errors import IntegrationError
from plant.parameters import load
from sil.campaign.campaign import load_campaign
from sil.inference.campaign.checks import observed
from sil.inference.campaign.diagnosis import available, diagnose
from sil.inference.campaign.model import CampaignModel, Floats
from sil.inference.candidate import Candidate, compatible, scaled_of
from sil.inference.fit import FitResult
from sil.inference.screening import change_of
from sil.inference.search import Search, Task
from sil.inference.spread import Spread
from tests.hidden_effects import effects
from tests.hidden_effects.campaign import hide, write_campaign

STROKES = 5
SEED = 7100
NONE = "none"
MOST = 3
"""Causes that a stepwise selection may add."""
TRIED = 8
"""Of the best single causes, so many are tried as further ones."""

BINS = 24
COMPONENTS = 40
HIDDEN = 48
EPOCHS = 60

Found = tuple[dict[str, float], float]
"""Probability by cause (NONE among them), and a score that grows with the evidence of any cause."""


def drawn(number: int) -> tuple[str, str]:
    """Return cause and level of a campaign: every third is clean."""
    rng = np.random.default_rng([SEED, number])
    name = str(rng.choice(list(effects.SIZES)))
    return (NONE if number % 3 == 0 else name), str(rng.choice(("easy", "medium")))


class Problem:
    """A campaign as all ways see it."""

    def __init__(self, folder: Path) -> None:
        """Read the campaign in the folder; fit the healthy model to all strokes."""
        self.campaign, self.parameters = load_campaign(folder), load()
        strokes, _findings = observed(self.campaign, self.parameters)
        self.model = CampaignModel(strokes, Spread.of(self.parameters))
        self.causes = available(strokes)
        self.search = Search(self.model, self.causes, range(len(strokes)))
        self.healthy = self.search.fitter.fit(iterations=8)


def ours(problem: Problem) -> Found:
    """Return what the diagnosis says; the verdict cannot_tell names nothing."""
    found = diagnose(problem.campaign, problem.parameters, workers=1)
    verdict = found.verdict
    best = min(item.score for item in found.judged)
    stated = {cause.id: cause.probability for cause in found.causes}
    if verdict.kind == "consistent":
        return {NONE: 1.0}, 0.0
    return stated, verdict.healthy.score - best if stated else 0.0


def stepwise(problem: Problem) -> Found:
    """Return the selection by BIC; probabilities by its weights among all fits of one cause and none."""
    search, healthy = problem.search, problem.healthy
    size = np.log(healthy.size)

    def bic(fit: FitResult) -> float:
        return fit.chi2 + size * len(fit.scaled)

    def fitted(parent: FitResult, more: Candidate) -> FitResult | None:
        starts = tuple((*parent.point, start) for start in more.starts)
        return search.attempt(
            Task((*parent.candidates, more), starts, (parent.shared, parent.stroke), 5)
        )

    singles = [fit for cause in problem.causes if (fit := fitted(healthy, cause)) is not None]
    singles.sort(key=bic)
    best = min([healthy, *singles], key=bic)
    likely = [fit.candidates[0] for fit in singles[:TRIED]]
    while best.candidates and len(best.candidates) < MOST:
        more = [fitted(best, c) for c in likely if compatible(c, best.candidates)]
        better = min((f for f in more if f is not None), key=bic, default=best)
        if bic(better) >= bic(best):
            break
        best = better
    weights = {NONE: np.exp(-0.5 * min(700.0, bic(healthy) - bic(singles[0])))}
    for fit in singles:
        name = fit.candidates[0].id
        own = np.exp(-0.5 * min(700.0, bic(fit) - bic(singles[0])))
        weights[name] = max(weights.get(name, 0.0), own)
    total = sum(weights.values())
    stated = {
        name: float(weight / total) for name, weight in weights.items() if weight > 1e-6 * total
    }
    # what was added to the best single is selected as surely as that one
    stated |= {cause.id: stated.get(best.candidates[0].id, 1.0) for cause in best.candidates[1:]}
    return stated, bic(healthy) - bic(best)


def responses(problem: Problem) -> tuple[list[Candidate], Floats, Floats]:
    """Return causes, their unit responses, and the residual, all freed of what healthy units may do."""
    healthy = problem.healthy
    blocks = list(healthy.blocks.values())
    shared = np.vstack([block.shared for block in blocks])
    nuisance = np.hstack([shared, block_diag(*(block.scatter for block in blocks))])
    inverse = np.linalg.inv(nuisance.T @ nuisance + np.eye(nuisance.shape[1]))
    causes, columns = [], []
    for cause in problem.causes:
        try:
            changes = change_of(problem.model, healthy, cause, cause.starts[0])
        except IntegrationError:
            continue
        causes.append(cause)
        size = abs(scaled_of(cause.parameters[0], cause.starts[0][0]))
        columns.append(np.concatenate(list(changes.values())) / size)

    def freed(values: Floats) -> Floats:
        return np.asarray(values - nuisance @ (inverse @ (nuisance.T @ values)))

    residual = np.concatenate([block.residual for block in blocks])
    return causes, freed(np.column_stack(columns)), freed(residual)


def sparse(problem: Problem, threshold: float = 0.1) -> Found:
    """Return what sequential thresholded least squares leaves; it knows no probabilities.

    threshold: in typical sizes of the causes.
    """
    causes, library, residual = responses(problem)
    active = np.linalg.norm(library, axis=0) > 1.0
    amounts = np.zeros(len(causes))
    for _ in range(10):
        amounts[:] = 0.0
        own = library[:, active]
        amounts[active] = np.linalg.solve(
            own.T @ own + 1e-3 * np.eye(own.shape[1]), own.T @ residual
        )
        left = active & (np.abs(amounts) > threshold)
        if (left == active).all() or not left.any():
            active = left
            break
        active = left
    if not active.any():
        return {NONE: 1.0}, 0.0
    gains = amounts**2 * np.sum(library**2, axis=0)
    gains[~active] = 0.0
    stated: dict[str, float] = {}
    for j in np.argsort(-gains)[: np.count_nonzero(active)]:
        stated.setdefault(causes[j].id, 1.0)
    return stated, float(residual @ residual - np.sum((residual - library @ amounts) ** 2))


def summary(problem: Problem, k: int, numbers: Floats) -> Floats:
    """Return means [BINS x channels] of a stroke's standardised difference from the nominal prediction."""
    stroke = problem.model.strokes[k]
    lengths = [len(channel.measured) for channel in stroke.channels]
    if stroke.internal is not None:
        lengths.append(len(stroke.internal.values_m))
    parts = np.split(numbers, np.cumsum(lengths)[:-1])
    return np.array([m.mean() for part in parts for m in np.array_split(part, BINS) if len(m)])


def virtual(problem: Problem, count: int) -> tuple[Floats, list[str], Floats]:
    """Return features of `count` virtual campaigns, what is hidden in each, and those of the real one."""
    model, rng = problem.model, np.random.default_rng(SEED)
    nothing = model.amounts(np.zeros(len(model.unit)), np.zeros(len(model.scatter)))
    strokes = range(len(model.strokes))
    nominal = [model.predict(k, model.setup(k, nothing, (), ()), True) for k in strokes]
    rows, labels = [], []
    while len(rows) < count:
        cause = None if rng.random() < 1 / 3 else problem.causes[rng.integers(len(problem.causes))]
        hidden: tuple[Candidate, ...] = () if cause is None else (cause,)
        values = () if cause is None else (_values(cause, rng),)
        unit, offsets = (
            rng.standard_normal(len(model.unit)),
            rng.standard_normal(len(model.offsets)),
        )
        features = []
        try:
            for k in strokes:
                amounts = model.amounts(unit, rng.standard_normal(len(model.scatter)))
                numbers = model.predict(k, model.setup(k, amounts, hidden, values), True)
                numbers = numbers - nominal[k] + model.offset_columns[k] @ offsets
                features.append(summary(problem, k, numbers + rng.standard_normal(len(numbers))))
        except IntegrationError:
            continue
        rows.append(np.concatenate(features))
        labels.append(NONE if cause is None else cause.id)
    real = [summary(problem, k, model.measured[k] - nominal[k]) for k in strokes]
    return np.arcsinh(np.array(rows)), labels, np.arcsinh(np.concatenate(real))


def _values(cause: Candidate, rng: np.random.Generator) -> dict[str, float]:
    """Return a cause's parameters between its starts, the main one drawn evenly in its logarithm."""
    one, two = (cause.starts[j] for j in rng.integers(len(cause.starts), size=2))
    share = rng.random()
    return {
        p.name: float(a + share * (b - a))
        for p, a, b in zip(cause.parameters, one, two, strict=True)
    }


def classifier(problem: Problem, count: int = 2500) -> Found:
    """Return the class probabilities of a network trained on virtual campaigns."""
    rng = np.random.default_rng(SEED + 1)
    features, labels, real = virtual(problem, count)
    names = sorted(set(labels))
    classes = np.array([names.index(label) for label in labels])
    centre, width = features.mean(axis=0), features.std(axis=0) + 1e-3
    _u, _s, axes = np.linalg.svd((features - centre) / width, full_matrices=False)
    axes = axes[:COMPONENTS]
    scores = (features - centre) / width @ axes.T
    scale = scores.std(axis=0) + 1e-9
    x, y = scores / scale, np.eye(len(names))[classes]
    weights = [
        rng.standard_normal((a + 1, b)) / a**0.5
        for a, b in ((x.shape[1], HIDDEN), (HIDDEN, len(names)))
    ]
    moments = [[np.zeros_like(w), np.zeros_like(w)] for w in weights]
    step = 0
    for _ in range(EPOCHS):
        for batch in np.array_split(rng.permutation(len(x)), max(1, len(x) // 64)):
            step += 1
            inner, out = _forward(weights, x[batch])
            error = (out - y[batch]) / len(batch)
            back = (error @ weights[1][:-1].T) * (1.0 - inner**2)
            gradients = [_with_one(x[batch]).T @ back, _with_one(inner).T @ error]
            for w, g, (mean, square) in zip(weights, gradients, moments, strict=True):
                g = g + 1e-4 * w
                mean += 0.1 * (g - mean)
                square += 0.001 * (g**2 - square)
                rate = 3e-3 * (1.0 - 0.999**step) ** 0.5 / (1.0 - 0.9**step)
                w -= rate * mean / (square**0.5 + 1e-8)
    probabilities = _forward(weights, ((real - centre) / width @ axes.T / scale)[None])[1][0]
    stated = {name: float(p) for name, p in zip(names, probabilities, strict=True)}
    return stated, 1.0 - stated.get(NONE, 0.0)


def _with_one(x: Floats) -> Floats:
    return np.column_stack([x, np.ones(len(x))])


def _forward(weights: Sequence[Floats], x: Floats) -> tuple[Floats, Floats]:
    inner = np.tanh(_with_one(x) @ weights[0])
    out = _with_one(inner) @ weights[1]
    out = np.exp(out - out.max(axis=1, keepdims=True))
    return inner, out / out.sum(axis=1, keepdims=True)


WAYS: dict[str, Callable[[Problem], Found]] = {
    "this diagnosis": ours,
    "BIC selection": stepwise,
    "sparse regression": sparse,
    "classifier": classifier,
}


def brier(stated: dict[str, float], true: str) -> float:
    """Return the sum of squared errors of all stated probabilities, the true cause's included."""
    return sum((stated.get(n, 0.0) - (n == true)) ** 2 for n in {*stated, true})


def measure() -> Iterator[str]:
    """Run what is missing; yield a line for each campaign, then the table."""
    folder = Path(os.environ.get("OPC4_STUDY", "runs/rivals"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {row["number"] for row in rows}
    first = int(os.environ.get("OPC4_FIRST", "0"))
    for number in range(first, first + int(os.environ.get("OPC4_STUDY_CAMPAIGNS", "24"))):
        if number in done:
            continue
        true, level = drawn(number)
        hidden = hide(() if true == NONE else (true,), level, SEED + number)
        campaign = write_campaign(folder / f"campaign_{number}", hidden, SEED + number, STROKES)
        problem = Problem(campaign)
        row: dict[str, Any] = {"number": number, "true": true, "level": level, "found": {}}
        for name, way in WAYS.items():
            begun = time.process_time()
            stated, score = way(problem)
            row["found"][name] = [stated, score, time.process_time() - begun]
        shutil.rmtree(campaign)
        rows.append(row)
        with path.open("a", encoding="utf-8") as out:
            out.write(json.dumps(row) + "\n")
        likeliest = {
            n: max(t, key=t.__getitem__, default="-") for n, (t, _s, _c) in row["found"].items()
        }
        yield f"{number}: {true} {level} -> {likeliest}"
    yield from table(rows)


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the table in Markdown; detected: above every clean campaign's score."""
    clean = [row for row in rows if row["true"] == NONE]
    ill = [row for row in rows if row["true"] != NONE]
    yield f"{len(rows)} campaigns of {STROKES} strokes, {len(clean)} of them clean"
    yield "| way | Brier score | right cause first | detected at no false alarm | clean left alone | CPU s |"
    yield "|---|---|---|---|---|---|"
    for name in WAYS:
        limit = max((row["found"][name][1] for row in clean), default=0.0)
        score = np.mean([brier(row["found"][name][0], row["true"]) for row in rows])
        first = [
            max(row["found"][name][0], key=row["found"][name][0].get, default="") for row in rows
        ]
        right = sum(a == row["true"] for a, row in zip(first, rows, strict=True) if row in ill)
        quiet = sum(a == NONE for a, row in zip(first, rows, strict=True) if row in clean)
        detected = sum(row["found"][name][1] > limit for row in ill)
        seconds = np.mean([row["found"][name][2] for row in rows])
        yield (
            f"| {name} | {score:.2f} | {right} of {len(ill)} | {detected} of {len(ill)} | "
            f"{quiet} of {len(clean)} | {seconds:.0f} |"
        )
