"""One hypothesis fitted to a campaign: the fit's simulations, times the cost of one stroke of each kind by scipy's judge."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

STROKES = 6
SEED = 41


def measure() -> Iterator[str]:
    """Lines: a stroke both ways, the fit, and the fit through scipy by the count of simulations."""
    import numpy as np

    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.inference.campaign.checks import observed
    from sil.inference.campaign.diagnosis import available
    from sil.inference.campaign.model import CampaignModel
    from sil.inference.fit import Fitter
    from sil.inference.spread import Spread
    from tests.hidden_effects.campaign import hide, write_campaign
    from tests.reference.actuator import Case, actuator

    folder = Path(tempfile.mkdtemp(prefix="opc4-bench-"))
    try:
        campaign = load_campaign(
            write_campaign(folder / "c", hide(("exhaust_clog",), "easy", SEED), SEED, STROKES)
        )
        parameters = load()
        strokes, _findings = observed(campaign, parameters)
    finally:
        shutil.rmtree(folder)
    model = CampaignModel(strokes, Spread.of(parameters))
    (clog,) = [c for c in available(strokes) if c.name == "exhaust_clog"]
    start = np.zeros(len(model.layout((clog,)).names))
    start[-1] = -1.0
    Fitter(model).fit((clog,), start=start, iterations=1)
    count = 0
    plain = model.predict

    def counted(*arguments, **options):  # type: ignore[no-untyped-def]
        nonlocal count
        count += 1
        return plain(*arguments, **options)

    model.predict = counted  # type: ignore[method-assign]
    begun = time.perf_counter()
    fit = Fitter(model).fit((clog,), start=start, fine=True)
    ours = time.perf_counter() - begun
    yield (
        f"fit of {clog.name} to {STROKES} strokes, {len(start)} shared parameters: {ours:.2f} s, "
        f"{fit.iterations} iterations, {count} simulations, {1e3 * ours / count:.2f} ms each in all"
    )
    theirs = 0.0
    for stroke in strokes:
        c = stroke.conditions
        case = Case(
            c.kind,
            c.supply_pressure_pa,
            c.commands,
            c.charged_before,
            "compressible" if c.load == "damper" else None,
            c.spring_n_per_m,
            c.start_offset_m,
        )
        begun = time.perf_counter()
        actuator(case).solve(stroke.time_s.tolist(), rtol=1e-7, max_step=2e-3)
        theirs += (time.perf_counter() - begun) / STROKES
    yield f"one of these strokes through scipy's solve_ivp: {1e3 * theirs:.0f} ms"
    yield f"the same fit through it: {count * theirs:.0f} s, {count * theirs / ours:.0f} times as long"
