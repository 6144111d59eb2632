"""Stored policies: what the searches have done, and the strokes of the best policy as a campaign."""

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
from sil.studies.bounds.search import BoundProblem, SearchProgress
from sil.studies.policies import GEARBOX

Search = Literal["cma", "linear"]
SEARCHES: tuple[Search, ...] = get_args(Search)


def read_progress(*folders: Path) -> dict[Search, SearchProgress]:
    """Return what each search has done, by the first folder that has it. Raises InputError for a wrong file."""
    paths = [folder / "policy.toml" for folder in folders]
    stored: dict[Search, SearchProgress] = {}
    for path in [path for path in paths if path.exists()][:1]:
        table = typed_toml.read_toml(path)
        stored = typed_toml.convert(table, dict[Search, SearchProgress], str(path))
        for name, each in stored.items():
            size = STEM_SIZE + 2 * sum(ANSWER.values()) * len(each.knots_s)
            if len(each.values) not in (0, size):
                wrong = f"{name}.values: {len(each.values)} numbers; expected {size}"
                raise InputError(f"{path}: {wrong}, for {len(each.knots_s)} knots")
    return dict.fromkeys(SEARCHES, SearchProgress()) | stored


def write_progress(folder: Path, progress: dict[Search, SearchProgress]) -> None:
    """Write what each search has done so far; what the values are: `sil.studies.bounds.policy`."""
    lines = []
    for name, each in progress.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {toml_value(x)}" for key, x in msgspec.structs.asdict(each).items()]
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "policy.toml", "\n".join(lines) + "\n")


def write_campaign(folder: Path, problem: BoundProblem, policy: SearchProgress) -> None:
    """Write strokes of a policy as campaign.toml, and model.toml with the delays of its valves.

    For commands early, as they are and late, and each mesh force: the least and the greatest impulse and
    that of the hardest stop, which the labels state.
    """
    judge, judgement = problem.judge, problem.judged(policy, problem.judge)
    release_s = judge.release_s(policy.policy).reshape(1, -1)
    edges = edges_of(policy.policy, policy.knots_s, release_s, problem.delay_s, judge.timing)
    scatter = np.arange(release_s.size) // (judge.shape[1] * judge.shape[2])
    edges, strokes = judge.shifted(edges, scatter), list[CampaignStroke]()
    for k, m in np.ndindex(judge.shape[:2]):
        impacts = judgement.impact_m_s[0, k, m]
        for i in sorted({0, int(np.argmax(impacts)), len(impacts) - 1}):
            conditions = replace(
                GEARBOX.cases[0],
                mesh_force_n=judge.mesh_n[m],
                sync_impulse_n_s=float(judge.impulses_n_s[i]),
                commands=tuple(
                    commands_of(edges, int(np.ravel_multi_index((k, m, i), judge.shape)))
                ),
            )
            label = f"{judge.mesh_n[m]:g} N, {judge.impulses_n_s[i]:g} N s, commands "
            label += f"{1e3 * judge.scatter[k].shift_s:+g} ms: {impacts[i]:.4f} m/s"
            strokes.append(CampaignStroke(f"stroke_{len(strokes):02}.csv", label, conditions))
    air = GEARBOX.cases[0].atmosphere_pa, GEARBOX.cases[0].temperature_k
    campaign = Campaign(folder, folder.name, "length", *air, 1000.0, strokes=tuple(strokes))
    write_atomically(folder / "campaign.toml", campaign_toml(campaign, strokes))
    delays = zip(("D_rise", "D_fall"), problem.timing, strict=True)
    lines = [
        f'{name} = {{ value = {s}, unit = "s", source = "study bounds" }}' for name, s in delays
    ]
    text = "\n".join(["[base]", 'model = "nominal"', "", "[valve]", *lines])
    write_atomically(folder / "model.toml", text + "\n")
