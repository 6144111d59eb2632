"""The plant alone under each stroke's conditions and commands: a campaign in, a campaign out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError, RunError
from plant.errors import IntegrationError, NoVolumeError
from plant.parameters import ParameterSet
from plant.systems.stroke import Stroke, simulate
from sil.campaign.campaign import (
    Campaign,
    CampaignStroke,
    Record,
    Recorder,
    campaign_toml,
    stroke_columns,
    write_record,
)
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value

TAIL_S = 0.1  # without a recorded time axis a stroke ends this long after its last command


@dataclass(frozen=True)
class SimulatedStroke:
    """A simulated stroke, the entry it came from, and its deviation from the record.

    rms: per column of the record, the root mean square of simulated minus recorded, in the
    column's unit; empty where the campaign holds conditions only.
    """

    entry: CampaignStroke
    stroke: Stroke
    rms: dict[str, float]

    @property
    def arrival_s(self) -> float:
        """First impact on an end stop, from the beginning of the record [s], nan for none."""
        impact = self.stroke.impact
        return impact.time_s if impact else math.nan

    @property
    def impact_speed_m_s(self) -> float:
        """Speed of that impact [m/s], nan for none."""
        impact = self.stroke.impact
        return impact.speed_m_s if impact else math.nan


def read_records(campaign: Campaign) -> list[Record | None]:
    """Return the records, None where there are conditions only. Raises InputError for a wrong one."""
    return [
        campaign.record(entry) if (campaign.folder / entry.file).exists() else None
        for entry in campaign.strokes
    ]


def simulate_campaign(
    campaign: Campaign, parameters: ParameterSet, records: Iterable[Record | None] | None = None
) -> Iterable[SimulatedStroke]:
    """Simulate every stroke of a campaign, sampled as its record (or at the stated rate).

    records: as `read_records` returns them, if they are read already. Raises RunError for a stroke
    whose motion cannot be continued, InputError for a record that is wrong.
    """
    records = read_records(campaign) if records is None else records
    for entry, recorded in zip(campaign.strokes, records, strict=True):
        if recorded is not None:
            time_s = recorded.time_s - recorded.time_s[0]
        else:
            end = max((command[0] for command in entry.conditions.commands), default=0.0) + TAIL_S
            time_s = np.arange(round(end * campaign.sample_rate_hz) + 1) / campaign.sample_rate_hz
        try:
            stroke = simulate(parameters, entry.conditions, time_s)
        except NoVolumeError:
            raise
        except IntegrationError as error:
            raise RunError(f"{entry.file}: {error}") from None
        rms = {}
        for name, values in stroke_columns(stroke).items():
            if recorded is not None and name in recorded and not name.startswith(("cmd_", "time")):
                rms[name] = float(np.sqrt(np.mean((values - recorded[name]) ** 2)))
        yield SimulatedStroke(entry, stroke, rms)


def write_campaign(
    campaign: Campaign,
    strokes: Iterable[SimulatedStroke],
    folder: Path,
    note: Callable[[SimulatedStroke], None],
) -> None:
    """Write simulated strokes as a campaign folder; campaign.toml last, so it is whole or absent."""
    written = []
    arrivals = [
        "# first end-stop impact of each stroke, from the beginning of the record; nan = none within it"
    ]
    for item in strokes:
        write_record(folder / item.entry.file, stroke_columns(item.stroke))
        arrivals += [
            "",
            "[[stroke]]",
            f"file = {toml_value(item.entry.file)}",
            f"arrival_s = {item.arrival_s:.9f}",
            f"impact_speed_m_s = {item.impact_speed_m_s:.7f}",
        ]
        written.append(item.entry)
        note(item)
    write_atomically(folder / "reference.toml", "\n".join(arrivals) + "\n")
    out = replace(campaign, name=f"{campaign.name}_simulated", recorder=Recorder())
    write_atomically(folder / "campaign.toml", campaign_toml(out, written))


def campaign_folder(out: Path, force: bool) -> Path:
    """Return the folder for a simulated campaign, emptied of another one with `force`, else InputError is raised."""
    campaign_file = out / "campaign.toml"
    if campaign_file.exists():
        if not force:
            raise InputError(
                f"{out}: --out: holds another campaign; expected an empty folder, or --force"
            )
        for old in [campaign_file, out / "reference.toml", *out.glob("stroke_*.csv")]:
            old.unlink(missing_ok=True)
    return out
