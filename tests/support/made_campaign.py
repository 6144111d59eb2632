"""A small measured campaign, made by the model with noise: for tests of the diagnosis' parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import shift
from plant.parameters import ParameterSet, load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup
from sil.campaign.campaign import (
    Campaign,
    CampaignStroke,
    campaign_toml,
    load_campaign,
    write_record,
)
from sil.inference.campaign.model import CampaignModel
from sil.inference.campaign.observations import observe
from sil.inference.spread import Spread

KINDS = (
    ("fixed", 900000.0),
    ("N-B", 900000.0),
    ("B-N", 900000.0),
    ("fixed", 600000.0),
    ("N-F", 750000.0),
    ("F-N", 600000.0),
    ("N-B", 600000.0),
    ("fixed", 750000.0),
)
DRIVES = {"fixed": "1", "N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}


def conditions_of(kind: str, supply_pa: float, closes: bool = True) -> StrokeConditions:
    """A plain stroke: open at 10 ms, close at 200 ms."""
    valve = DRIVES[kind]
    close = ((0.2, valve, 0.0),) if closes else ()
    return StrokeConditions(
        kind=kind, supply_pressure_pa=supply_pa, commands=((0.01, valve, 0.98), *close)
    )


def made(
    folder: Path,
    parameters: ParameterSet | None = None,
    seed: int = 1,
    count: int = 8,
    kinds: Sequence[tuple[str, float]] = KINDS,
    closes: bool = True,
) -> Campaign:
    """Write and read a campaign of `count` strokes under `parameters` (nominal by default)."""
    parameters = parameters or load()
    generator = np.random.default_rng(seed)
    spread = Spread.of(load())
    unit = {name: generator.normal(0.0, size) for name, size in spread.unit.items()}
    gauge_pa = generator.normal(0.0, spread.offset["pressure"], 3)
    time_s = np.arange(3001) * 1e-4
    entries = []
    folder.mkdir(parents=True, exist_ok=True)
    for number, (kind, supply_pa) in enumerate(kinds[:count], start=1):
        conditions = conditions_of(kind, supply_pa, closes)
        setup = make_setup(parameters, conditions)
        for name, amount in unit.items():
            shift(setup, name, amount)
        for name, size in spread.stroke.items():
            shift(setup, name, generator.normal(0.0, size))
        setup.phase_s = generator.uniform(0.0, 0.01)
        stroke = run_setup(setup, time_s)
        noise = generator.normal(0.0, 1e-5, len(time_s))
        columns = {
            "time_s": time_s,
            "position_m": np.rint((stroke.position_m + noise) / 5e-5) * 5e-5,
        }
        for k, name in enumerate(conditions.chambers):
            noise = generator.normal(gauge_pa[k], 300.0, len(time_s))
            columns[f"pressure_{name}_pa"] = stroke.pressure_pa(name) + noise
        columns["position_internal_m"] = stroke.internal_m
        file = f"stroke_{number:03d}.csv"
        write_record(folder / file, columns)
        entries.append(CampaignStroke(file, kind, conditions))
    campaign = Campaign(folder, "made", "both", 101325.0, 293.15, 10000.0, tuple(entries))
    (folder / "campaign.toml").write_text(campaign_toml(campaign, entries), encoding="utf-8")
    return load_campaign(folder)


def model_of(campaign: Campaign) -> CampaignModel:
    """The campaign's strokes ready to be fitted."""
    parameters = load()
    strokes = [observe(entry, campaign.record(entry), parameters) for entry in campaign.strokes]
    return CampaignModel(strokes, Spread.of(parameters))
