"""Parameters of the model fitted to whole records of a campaign, healthy scatter included.

The same whole-campaign fit as the diagnosis': tolerances of the unit, gauge offsets and each
stroke's own scatter are fitted with the parameters, under their priors.
Checked by: tests/unit/sil/inference/identify/test_identify.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from plant.effects import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, CampaignStroke
from sil.files.quantity import counted
from sil.inference.campaign.observations import observe
from sil.inference.campaign.tangent_model import TangentModel
from sil.inference.candidate import Candidate
from sil.inference.evidence import misfit
from sil.inference.fit import Fitter, Show, no_progress
from sil.inference.identify.estimate import Estimate
from sil.inference.spread import Spread


def fit_factors(
    campaign: Campaign,
    strokes: Sequence[CampaignStroke],
    parameters: ParameterSet,
    indices: Mapping[str, int],
    known: Sequence[str] = (),
    progress: Show = no_progress,
) -> tuple[tuple[Estimate, ...], float]:
    """Fit factors on packed parameters; return estimates, and the residual over its expected noise.

    indices: parameter path -> its index in the packed array; known: healthy unit tolerances that
    the parameters themselves express (frozen at zero).
    """
    from scipy.stats import t as student

    observed = [
        replace(observe(entry, campaign.record(entry), parameters), internal=None)
        for entry in strokes
    ]
    model = TangentModel(observed, Spread.of(parameters))
    source = f"whole-record fit of {counted(len(strokes), 'stroke')} with their scatter"

    def change(setup: Setup, values: dict[str, float]) -> None:
        for path, index in indices.items():
            setup.p[index] *= values[path]

    own = tuple(EffectParameter(path, "-", 1.0, 0.05, 20.0, 0.1) for path in indices)
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
    for k, path in enumerate(indices):
        row = free.index(layout.effect_slice.start + k)
        base = parameters.value(path)
        centre = base * found.values[0][path]
        half = quantile * float(np.sqrt(covariance[row, row] * reduced)) * 0.1 * base
        estimates.append(Estimate(path, centre, centre - half, centre + half, source))
    return tuple(estimates), misfit(model, found).rms
