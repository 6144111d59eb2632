"""A truck's shifts judged: hypotheses searched, fitted to some shifts and then to all.

Every hypothesis, none or one cause, is fitted together with all in which healthy trucks differ, and
scored by its evidence (Laplace). The priors of the truck's quantities have heavy tails, so that an
unusual truck is not called a faulty one. Where the best hypothesis
leaves more than noise, all scores count less in proportion.
Checked by: tests/unit/sil/shift_diagnosis/test_judge.py, test_diagnose_logs.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.files.progress import Progress
from sil.files.quantity import counted
from sil.inference.fit import no_progress
from sil.inference.workers import Stages
from sil.shift_diagnosis.challenge import alike_by_theory, challenged
from sil.shift_diagnosis.fit import Fitter, fits_of
from sil.shift_diagnosis.healthy import (
    loaded_fit,
    rest_noise_m,
    spread,
)
from sil.shift_diagnosis.linear import (
    NOISE,
    Floats,
    Noise,
)
from sil.shift_diagnosis.loads import with_speeds
from sil.shift_diagnosis.model import Cause, PlantModel, catalogue
from sil.shift_diagnosis.odd import with_odd, without_odd
from sil.shift_diagnosis.polish import continued
from sil.shift_diagnosis.search import (
    around_best,
    close_ones,
    final_fit,
    healthy_again,
    healthy_share,
    is_settled,
    linear_at,
    on_all,
    promising,
    second_attempt,
    with_rivals,
)
from sil.shift_diagnosis.shifts import RecordedShift
from sil.shift_diagnosis.verdict import (
    DOUBTED,
    Judged,
    ShiftDiagnosis,
    detectable_of,
    verdict_of,
    weighed,
)

MOST_SHIFTS: Final = 120
"""Shifts that are judged; of more, as many spread evenly over the logs."""
AS_GOOD: Final = 5.0
"""Log evidence within which another minimum of a fit is as good: its size is in the interval."""
SAME: Final = 0.995
"""Correlation of what two causes do from which one of them is not offered."""
FEWEST_SHIFTS: Final = 3
VARIES_PA: Final = 2e4
"""Standard deviation of the supply pressure from which what depends on it can be distinguished."""


def judge_shifts(
    shifts: Sequence[RecordedShift],
    parameters: ParameterSet,
    progress: Progress | None = None,
    workers: int = 1,
) -> ShiftDiagnosis:
    """Judge the shifts of one truck against the plant of a parameter set, on so many processes."""
    stages = Stages(progress or no_progress)
    left_out = Counter[str]()
    used = spread(with_speeds(shifts, left_out), MOST_SHIFTS)
    missing = [f"{counted(n, 'shift')} {why} left out" for why, n in left_out.items()]
    if len(used) < FEWEST_SHIFTS:
        text = f"{counted(len(used), 'usable shift')}; at least {FEWEST_SHIFTS} are needed to judge"
        return ShiftDiagnosis(
            "cannot_tell", tuple(used), (), {}, (), True, NOISE, (text, *missing), {}
        )
    models = [PlantModel(parameters, mounted) for mounted in (True, False)]
    fitter, healthy, used = loaded_fit(models, used, Noise(rest_noise_m(used)))
    stages.until(15.0)(1.0, 1.0)
    causes = offered(used)
    linear = linear_at(fitter, used, healthy, causes)
    alone = linear.information.sum(axis=0)[linear.units :, linear.units :]
    causes = [cause for k, cause in enumerate(causes) if not _repeats(k, causes, alone)]
    run = partial(fits_of, workers=workers)
    chosen = promising(fitter, healthy, linear, causes, partial(run, progress=stages.until(35.0)))
    fits = [healthy, *run(fitter.fit, chosen, progress=stages.until(50.0))]
    fits += around_best(fitter, fits, causes, partial(run, progress=stages.until(55.0)))
    close = close_ones(fits)
    minima = {
        best.cause: tuple(
            fit.size for fit in fits if fit.cause is best.cause and fit.cost < best.cost + AS_GOOD
        )
        for best in close
        if best.cause is not None
    }
    close[0] = fitter.settle(close[0])
    whole = Fitter(fitter.model, used, fitter.noise)
    leading = on_all(whole, close, partial(run, progress=stages.until(60.0)))
    weights, odd = without_odd(leading[0], whole)
    whole.noise = replace(whole.noise, weights=weights)
    starts = {fit.cause: fit.point for fit in (*close, *leading)}
    finish = partial(final_fit, whole)
    ids = len({cause.effect.id for cause in causes})
    finals = run(finish, list(starts.items()), progress=stages.until(75.0))
    judged = weighed([Judged.of(fit) for fit in finals], ids)
    if not is_settled(judged, ids):
        own = partial(run, progress=stages.until(80.0))
        judged = weighed(with_rivals(whole, judged, causes, own), ids)
    judged = weighed(healthy_again(whole, judged), ids)
    if healthy_share(judged) < DOUBTED:
        own = partial(run, progress=stages.until(90.0))
        judged = weighed(second_attempt(fitter, whole, judged, causes, own), ids)
        own = partial(run, progress=stages.until(92.0))
        judged = weighed(with_rivals(whole, judged, causes, own), ids)
        judged = weighed(continued(whole, judged, partial(run, progress=stages.until(94.0))), ids)
        judged = weighed(healthy_again(whole, judged), ids)
    own = partial(run, progress=stages.until(98.0))
    judged = challenged(whole, judged, causes, ids, own)
    detectable = detectable_of(linear_at(whole, used, judged[0].fit, causes), ids)
    judged = weighed(judged, ids, alike_by_theory(judged, detectable))
    judged = [
        item if item.fit.cause is None else replace(item, minima=minima.get(item.fit.cause, ()))
        for item in judged
    ]
    probabilities: dict[str, float] = {}
    for item in judged:
        probabilities[item.id] = probabilities.get(item.id, 0.0) + item.probability
    verdict, findings = verdict_of(judged, probabilities, detectable)
    if odd:
        verdict, findings = with_odd(verdict, findings, used, odd)
    return ShiftDiagnosis(
        verdict, tuple(used), tuple(judged), probabilities, detectable, fitter.model.mounted,
        fitter.noise, (*findings, *missing), fitter.model.unit,
    )  # fmt: skip


def offered(shifts: Sequence[RecordedShift]) -> list[Cause]:
    """Return the catalogue's causes, those by the supply pressure only if that is known to vary."""
    supplies = [s.supply_pa for s in shifts if not np.isnan(s.supply_pa)]
    varies = len(supplies) > 1 and float(np.std(supplies)) > VARIES_PA
    return [c for c in catalogue() if varies or not c.effect.switching or c.effect.tolerance]


def _repeats(k: int, causes: Sequence[Cause], information: Floats) -> bool:
    """Return whether a cause does the same to these shifts as another that says it more simply.

    That is an earlier variant of the same effect, or, where the condition of an effect on the
    valves' switching does not vary, the effect that has none.
    """
    diagonal = np.maximum(np.diag(information), 1e-12)
    own = causes[k].effect
    return any(
        abs(information[j, k]) > SAME * float(np.sqrt(diagonal[j] * diagonal[k]))
        and (
            (other.effect is own and j < k)
            or (own.switching and other.effect.switching == own.switching and not own.tolerance)
        )
        for j, other in enumerate(causes)
        if j != k
    )
