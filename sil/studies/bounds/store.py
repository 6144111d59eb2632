"""Stored policies: what the searches have done, and the strokes of the best policy as a campaign.

Checked by: tests/unit/sil/studies/bounds/test_store.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np

from can_dbc import typed_toml
from can_dbc.errors import InputError
from sil.campaign.campaign import Campaign, CampaignStroke, campaign_toml
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value
from sil.studies.bounds.policy import ANSWER, STEM_SIZE, commands_of, edges_of
from sil.studies.bounds.search import Problem, Progress
from sil.studies.policies import GEARBOX

Search = Literal["cma", "differential"]
SEARCHES: tuple[Search, ...] = get_args(Search)


def read_progress(folder: Path) -> dict[Search, Progress]:
    """Return what each search has done so far. Raises InputError for a file that is wrong."""
    path = folder / "policy.toml"
    stored: dict[Search, Progress] = {}
    if path.exists():
        table = typed_toml.read_toml(path)
        stored = typed_toml.convert(table, dict[Search, Progress], str(path))
    for name, each in stored.items():
        size = STEM_SIZE + 2 * sum(ANSWER.values()) * len(each.knots_s)
        if len(each.values) not in (0, size):
            wrong = f"{name}.values: {len(each.values)} numbers; expected {size}"
            raise InputError(f"{path}: {wrong}, for {len(each.knots_s)} knots")
    return dict.fromkeys(SEARCHES, Progress()) | stored


def write_progress(folder: Path, progress: dict[Search, Progress]) -> None:
    """Write what each search has done so far; what the values are: `sil.studies.bounds.policy`."""
    lines = []
    for name, each in progress.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {toml_value(x)}" for key, x in msgspec.structs.asdict(each).items()]
    write_atomically(folder / "policy.toml", "\n".join(lines) + "\n")


def write_campaign(folder: Path, problem: Problem, policy: Progress) -> None:
    """Write strokes of a policy as campaign.toml, and model.toml with the delays of its valves.

    Strokes: for commands early, as they are and late, and each mesh force, the hardest stop and five
    impulses over the range. Their labels state the stop.
    """
    judge, judgement = problem.judge, problem.judged(policy, problem.judge)
    release_s = judge.held(policy.policy)[0].reshape(1, -1)
    delay_s = problem.delay_s + policy.waits_s
    edges = edges_of(policy.policy, policy.knots_s, release_s, delay_s, judge.timing)
    scatter = np.arange(release_s.size) // (judge.shape[1] * judge.shape[2])
    edges, impacts = judge.shifted(edges, scatter), judgement.impact_m_s[0]
    some = np.linspace(0, judge.shape[2] - 1, 5).round().astype(int)
    strokes: list[CampaignStroke] = []
    for k, m in np.ndindex(judge.shape[:2]):
        for i in np.unique([*some, int(np.argmax(impacts[k, m]))]):
            conditions = replace(
                GEARBOX.cases[0],
                mesh_force_n=judge.mesh_n[m],
                sync_impulse_n_s=float(judge.impulses_n_s[i]),
                commands=tuple(commands_of(edges, np.ravel_multi_index((k, m, i), judge.shape))),
            )
            label = f"{judge.mesh_n[m]:g} N, {judge.impulses_n_s[i]:g} N s, commands "
            label += f"{1e3 * judge.scatter[k].shift_s:+g} ms: {impacts[k, m, i]:.4f} m/s"
            strokes.append(CampaignStroke(f"stroke_{len(strokes):02}.csv", label, conditions))
    first = strokes[0].conditions
    campaign = Campaign(
        *(folder, folder.name, "length", first.atmosphere_pa, first.temperature_k, 1000.0),
        strokes=tuple(strokes),
    )
    write_atomically(folder / "campaign.toml", campaign_toml(campaign, strokes))
    delays = {"D_rise": problem.timing.rise_s, "D_fall": problem.timing.fall_s}
    lines = ["[base]", 'model = "nominal"', "", "[valve]"]
    lines += [
        f'{name} = {{ value = {delay_s}, unit = "s", source = "study bounds" }}'
        for name, delay_s in delays.items()
    ]
    write_atomically(folder / "model.toml", "\n".join(lines) + "\n")
