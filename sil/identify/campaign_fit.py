"""Parameters of the model fitted to whole records of a campaign, healthy scatter included.

The same whole-campaign fit as the diagnosis': tolerances of the unit, gauge offsets and each
stroke's own scatter are fitted with the parameters, under their priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plant.effects import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, CampaignStroke
from sil.fitting.fit import Fitter
from sil.fitting.floor import misfit
from sil.fitting.hypotheses import Candidate
from sil.fitting.nuisance import Spread
from sil.fitting.observations import observe
from sil.identify.estimate import Estimate, Show, no_progress
from sil.identify.tangent_model import TangentModel


@dataclass(frozen=True)
class Fitted:
    """Estimates of the parameters, and the rms of the residual over its expected noise."""

    estimates: tuple[Estimate, ...]
    over_noise: float


def fit_factors(
    campaign: Campaign,
    strokes: Sequence[CampaignStroke],
    parameters: ParameterSet,
    indices: dict[str, tuple[int, ...]],
    known: Sequence[str],
    source: str,
    progress: Show = no_progress,
) -> Fitted:
    """Fit factors on packed parameters.

    indices: parameter path -> its indices in the packed array; known: healthy unit tolerances that
    the parameters themselves express (frozen at zero).
    """
    from scipy.stats import t as student

    observed = [
        replace(observe(entry, campaign.record(entry), parameters), internal=None)
        for entry in strokes
    ]
    model = TangentModel(observed, Spread.of(parameters))
    paths = tuple(indices)

    def change(setup: Setup, values: dict[str, float]) -> None:
        for path in paths:
            for index in indices[path]:
                setup.p[index] *= values[path]

    own = tuple(EffectParameter(path, "-", 1.0, 0.05, 20.0, 0.1) for path in paths)
    effect = Effect("identified", "identified", "force", source, own, change)
    candidate = Candidate(effect, "", own, ())
    layout = model.layout((candidate,))
    frozen = [layout.names.index(name) for name in known]
    start = np.zeros(len(layout.names))
    found = Fitter(model, progress).fit((candidate,), start=start, freeze=frozen, iterations=20)
    free = [k for k in range(len(layout.names)) if k not in frozen]
    covariance = np.linalg.pinv(found.normal[np.ix_(free, free)])
    reduced = max(1.0, found.chi2 / found.size)
    # the prior of the scatter counts about as much as two strokes
    quantile = float(student.ppf(0.975, len(strokes) + 1))
    estimates = []
    for k, path in enumerate(paths):
        row = free.index(layout.effect_slice.start + k)
        base = parameters.value(path)
        centre = base * found.values[0][path]
        half = quantile * float(np.sqrt(covariance[row, row] * reduced)) * 0.1 * base
        estimates.append(Estimate(path, centre, centre - half, centre + half, source))
    return Fitted(tuple(estimates), misfit(model, found).rms)
