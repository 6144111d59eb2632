"""report.html of a diagnosis: one self-contained page.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from plant.effects import look_alikes
from plant.effects.user_file import MARK, loaded_effects
from sil.campaign.campaign import campaign_toml
from sil.files.atomic import write_atomically
from sil.files.quantity import noun
from sil.inference.campaign.causes import relative_errors
from sil.inference.campaign.diagnosis import FALSE_ALARM_BASIS, Diagnosis
from sil.inference.campaign.figures import next_figure, strokes_figure, term_figure
from sil.inference.candidate import form_of
from sil.inference.fit import Tried
from sil.inference.report import FALSE_ALARM_LEVEL, ReportedCause
from sil.inference.verdict import Judged
from sil.inference.workers import spread_out
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render


def write_next(result: Diagnosis, folder: Path) -> str | None:
    """Write next/campaign.toml, the strokes to measure next; return its path, None without any."""
    if result.next_experiment is None:
        return None
    following = replace(result.campaign, name=f"{result.campaign.name}, next")
    path = folder / "next" / "campaign.toml"
    path.parent.mkdir(exist_ok=True)
    write_atomically(path, campaign_toml(following, result.next_experiment.entries))
    return str(path)


def write_report(
    result: Diagnosis, folder: Path, arguments: str, workers: int = 1
) -> dict[str, Any]:
    """Write report.html and its figures; return the page's numbers beyond those of `Diagnosis.as_json`.

    arguments: of the command that makes it again. An extended model is in the folder already.
    """
    stamps = dict.fromkeys(loaded_effects().values())
    files = "".join(f" --effects {stamp.partition(MARK)[0]}" for stamp in stamps)
    before, after = (relative_errors(result.model, f) for f in (result.healthy, result.final))
    strokes = strokes_figure(result)
    figures = {"strokes": strokes}
    terms = {c.name: c for c in result.final.candidates if c.is_term}
    for cause in result.causes:
        candidate = terms.get(f"{cause.id}:{cause.variant}")
        if candidate is not None:
            figures["term"] = term_figure(form_of(candidate), list(cause.parameters.values()))
    if result.next_experiment is not None:
        figures["next"] = next_figure(result.next_experiment)
    where = "held out" if result.held_out else "measured"
    images = spread_out(lambda name: save(figures[name], folder, name), list(figures), workers)
    captions = {
        "strokes": (
            "Measured and simulated strokes",
            f"The strokes that the given model fits worst among those {where}. Grey: measured. Orange: "
            "the healthy model, its tolerances and scatter fitted. Blue: the extended model. Below each: "
            "residuals over their expected scatter; the band is three standard deviations.",
        ),
        "next": (
            "The stroke that tells most",
            "What the two predict of the first stroke to measure, and their difference over the noise; the "
            "band is three standard deviations. Tolerances and scatter may follow a part of it.",
        ),
        "term": (
            "What is missing",
            "What none of the named causes describes, as a function without a form: its value at the "
            "nodes and their 95 % interval.",
        ),
    }
    pictures = {
        name: Picture(image, *captions[name]) for name, image in zip(figures, images, strict=True)
    }
    kind = result.verdict.kind
    again = f"opc4 diagnose {arguments}{files}"
    counts = {i.name: result.refusals.get(i.name, Tried(i.ids)) for i in result.judged}
    page = render(
        "diagnosis.html",
        Head("diagnose", result.campaign.name, kind, kind == "consistent", _tiles(result), again),
        plots(strokes),
        result=result,
        causes=[(c, _parameter_lines(c), _look_alikes(c, result)) for c in result.causes],
        pictures=pictures,
        judged=[(i, _fitted_values(i), counts[i.name]) for i in result.judged[:12]],
        before=before,
        after=after,
        in_unit=_in_unit,
        false_alarm=f"False alarms, level aimed at: {FALSE_ALARM_LEVEL:.0%}; {FALSE_ALARM_BASIS}",
    )
    write_atomically(folder / "report.html", page)
    first = result.judged[0].score
    explanations = [
        {
            "name": item.name,
            "behind": item.score - first,  # in log evidence
            "probability": item.probability,
            "left_over": item.misfit.rms,
            "tried": counts[item.name].tried,
            "refused": counts[item.name].refused,
            "parameters": {
                candidate.name: dict(values)
                for candidate, values in zip(
                    item.training.candidates, item.training.values, strict=True
                )
            },
        }
        for item in result.judged
    ]
    errors = {n: {"before": asdict(before[n]), "after": asdict(e)} for n, e in after.items()}
    return {"explanations": explanations, "relative_errors": errors}


def _look_alikes(cause: ReportedCause, result: Diagnosis) -> str:
    """Return the cause's look-alikes that were fitted to the end, and how far each is behind."""
    texts = []
    for other in look_alikes(cause.id):
        scores = [i.score for i in result.judged if other in i.ids and cause.id not in i.ids]
        if scores:
            texts.append(f"{other} {min(scores) - result.verdict.leader.score:,.0f}")
    return ", ".join(texts)


def _parameter_lines(cause: ReportedCause) -> list[str]:
    """Return the parameters as lines; a term's nodes as one."""
    items = cause.parameters.items()
    if "node_00" in cause.parameters:
        return ["nodes: " + ", ".join(f"{item.value:.3g}" for _name, item in items)]
    return [f"{name} {item}{f' ({item.note})' if item.note else ''}" for name, item in items]


def _tiles(result: Diagnosis) -> list[tuple[str, str]]:
    """Return the figures at the top as (value, name)."""
    count = len(result.model.strokes)
    tiles = [
        (str(count), noun(count, "stroke")),
        (str(len(result.held_out)), "of them held out"),
        (f"{result.gain.before:.3g}", "residual over expected, before"),
    ]
    for first in result.causes[:1]:
        tiles.append((f"{result.gain.after:.3g}", "after"))
        tiles.append((f"{first.probability:.2f}", f"probability of {first.id}"))
    return tiles


def _fitted_values(item: Judged) -> str:
    """Return the fitted parameters of an explanation."""
    texts = []
    for candidate, values in zip(item.training.candidates, item.training.values, strict=True):
        if candidate.is_term:
            texts.append(f"{len(values)} nodes")
        else:
            texts += [f"{name} {value:.4g}" for name, value in values.items()]
    return ", ".join(texts)


def _in_unit(name: str, value: float) -> str:
    """Return an rms in the unit that an engineer reads."""
    return f"{value / 1e5:.4f} bar" if name.endswith("_pa") else f"{value * 1e3:.4f} mm"
