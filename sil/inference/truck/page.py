"""diagnosis.json, extended_model.toml and report.html of a truck's shifts.

Checked by: tests/unit/sil/inference/truck/test_page.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from plant.parameters import Parameter
from sil.files.atomic import write_atomically
from sil.files.quantity import counted, noun
from sil.inference.report import (
    Interval,
    ReportedCause,
    diagnosis_json,
    headline,
    model_file,
    seen_sentence,
)
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.truck.detectable import Detectable
from sil.inference.truck.diagnosis import TruckDiagnosis
from sil.inference.truck.verdict import MIN_SHIFTS, Hypothesis
from sil.log_replay.recorded_shifts import LEAD_S
from sil.report.figure import MM, MS, Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render


def reported(diagnosis: TruckDiagnosis) -> list[ReportedCause]:
    """Return the causes as diagnosis.json holds them, the most probable first."""
    if diagnosis.verdict is None:
        return []
    causes = []
    healthy, probabilities = diagnosis.verdict.healthy, diagnosis.verdict.probabilities
    for item in diagnosis.verdict.causes:
        cause = item.fit.cause
        assert cause is not None
        effect, name = cause.effect, cause.parameter.name
        own = {name: interval(item)}
        gain = item.fit.evidence - healthy.fit.evidence
        before, after = (f"{fit.noise_factor:.2f}" for fit in (healthy.fit, item.fit))
        noise = (
            f", and the noise that is left falls from {before} to {after} times the expected one"
        )
        text = (
            f"{effect.what}: {name} {own[name]}; over {counted(len(diagnosis.shifts), 'shift')} it gains "
            f"{gain:.1f} in log evidence{noise if after != before else ''}"
        )
        ids = {other.fit.id for other in diagnosis.verdict.causes} - {cause.id}
        if alike := [name for name in alike_of(diagnosis, cause.id) if name in ids]:
            text += f"; the bus cannot distinguish it from {', '.join(alike)}"
        causes.append(
            ReportedCause(effect.id, effect.cause_class, probabilities[effect.id], own, text)
        )
    return causes


def interval(item: Hypothesis) -> Interval:
    """Return the 95 % interval of a cause's parameter, in its unit."""
    cause, ends = item.fit.cause, item.interval
    assert cause is not None and ends is not None
    values = [cause.value(size) for size in ends]
    return Interval(cause.value(item.fit.size), min(values), max(values), cause.parameter.unit)


def alike_of(diagnosis: TruckDiagnosis, name: str) -> tuple[str, ...]:
    """Return the ids of the causes that these shifts cannot distinguish from one.

    Whichever of two is tested against the other: one of them might be noticed at no size.
    """
    own = next((item.alike for item in diagnosis.detectable if item.cause.id == name), ())
    others = [item.cause.id for item in diagnosis.detectable if name in item.alike]
    return tuple(dict.fromkeys((*own, *others)))


def noticed_of(diagnosis: TruckDiagnosis) -> list[Detectable]:
    """Return what these shifts would show."""
    return [item for item in diagnosis.detectable if item.size is not None]


def groups_of(diagnosis: TruckDiagnosis) -> list[dict[str, Any]]:
    """Return each group of causes that the bus cannot separate, with what would separate it."""
    groups: dict[frozenset[str], dict[str, Any]] = {}
    classes = {item.cause.id: item.cause.effect.cause_class for item in diagnosis.detectable}
    measures = {
        "valve timing": "the chambers' pressures at 1 kHz or more: when each begins to rise and to fall after its command",
        "internal sensor": "the position by an external sensor on the same clock",
        "friction": "the chambers' pressures together with an external position: the force balance of the stay",
        "mechanics": "the stay moved by hand or by a known force, unpressurised",
        "leak": "a chamber's pressure with its valve held open, then closed, the stay at rest",
        "supply": "the pressure at the valve's inlet during a shift",
        "flow restriction": "a chamber's pressure while it fills and empties at a known volume",
        "volume": "a chamber's pressure while it fills and empties with the stay held",
        "thermodynamics": "a chamber's pressure along a measured position",
    }
    for item in diagnosis.detectable:
        ids = frozenset((item.cause.id, *item.alike))
        if len(ids) > 1 and ids not in groups:
            kinds = sorted({classes[name] for name in ids})
            measure = [measures[kind] for kind in kinds if kind in measures]
            groups[ids] = {"causes": sorted(ids), "of": item.cause.name, "measure": measure}
    return list(groups.values())


def as_json(diagnosis: TruckDiagnosis, logs: list[str], skipped: dict[str, int]) -> dict[str, Any]:
    """Return the object of diagnosis.json."""
    causes = reported(diagnosis)
    ids = {cause.id for cause in causes}
    groups = groups_of(diagnosis)
    findings = list(diagnosis.findings) + [
        f"{counted(n, 'shift')} {why} left out" for why, n in skipped.items()
    ]
    verdict, shown = diagnosis.verdict, None
    if verdict is not None:
        findings.append("on a gearbox" if verdict.best.fit.mounted else "on a rig without gearbox")
        if unseen := [item.cause.id for item in diagnosis.detectable if item.size is None]:
            findings.append(f"would not have been noticed at any size: {', '.join(unseen)}")
        shown = {"healthy": diagnosis.chi2(verdict.healthy), "best": diagnosis.chi2(verdict.best)}
    return diagnosis_json(
        Path(logs[0]).name + (f" and {len(logs) - 1} more" if len(logs) > 1 else ""),
        diagnosis.kind,
        causes,
        findings,
        f"posterior of a healthy truck at most {LIMITS.max_healthy_probability:g}, with priors on what "
        "differs between healthy trucks and their shifts; measured on drawn truck logs (docs, accuracy)",
        headline=headline_of(diagnosis, causes),
        rivals=[g["causes"] for g in groups if ids.intersection(g["causes"])],
        extended_model="extended_model.toml" if diagnosis.kind == "named" else None,
        logs=logs,
        shifts=len(diagnosis.shifts),
        noise_m=diagnosis.noise_m,
        scatter=scatter_of(diagnosis),
        probabilities={
            name: round(p, 4) for name, p in (verdict.probabilities if verdict else {}).items()
        },
        chi2_per_number=shown,
        groups=groups,
        detectable=[
            {
                "id": item.cause.id,
                "parameter": item.cause.parameter.name,
                "size": item.value,
                "unit": item.cause.parameter.unit,
                "alike": list(item.alike),
            }
            for item in noticed_of(diagnosis)
        ],
        truck=truck_rows(diagnosis),
        assumed=[
            "The actuator is that of the model within the tolerances of its section repeatability.",
            "Gearbox mass, linkage friction, barriers of the teeth, cone and supply are unknown within "
            "wide priors, and differ from shift to shift.",
            "Pulses are reported 1.5 ms after their start, and every frame as soon as the bus is free.",
            "PlantMotion and PlantPressures are not used: a truck's bus does not have them.",
        ],
    )


def headline_of(diagnosis: TruckDiagnosis, causes: list[ReportedCause]) -> str:
    """Return the one sentence that a reader needs first; shifts that failed stand before it."""
    first = diagnosis.findings[0] if diagnosis.findings else ""
    if diagnosis.kind == UNNAMED:
        few = len(diagnosis.shifts) < MIN_SHIFTS
        why = "too few shifts to tell why" if few else "no cause of the catalogue explains it"
        return f"Something is wrong: {first}; {why}."
    seen = seen_sentence(
        (i.cause.id, i.value, i.cause.parameter.neutral, i.cause.parameter.unit)
        for i in noticed_of(diagnosis)
        if i.value is not None and not i.cause.is_narrowing
    )
    text = headline(diagnosis.kind, causes, seen, first)
    return f"{counted(diagnosis.failed, 'shift')} failed. {text}" if diagnosis.failed else text


def scatter_of(diagnosis: TruckDiagnosis) -> dict[str, float]:
    """Return the standard deviations between shifts under the best hypothesis, by quantity, in its unit."""
    if diagnosis.verdict is None:
        return {}
    fit = diagnosis.verdict.best.fit
    layout = diagnosis.fitter(fit).layout
    names = [layout.own[k].name for k in layout.differing]
    return dict(zip(names, (fit.spread * layout.shift_sd).tolist(), strict=True))


def truck_rows(diagnosis: TruckDiagnosis) -> list[dict[str, Any]]:
    """Return the truck's own quantities under the best hypothesis, with 95 % intervals."""
    if diagnosis.verdict is None:
        return []
    fit = diagnosis.verdict.best.fit
    assert fit.unit_sd is not None
    rows = []
    for k, item in enumerate(diagnosis.fitter(fit).layout.own):
        value, half = (item.unit_sd * float(x) for x in (fit.unit[k], 1.96 * fit.unit_sd[k]))
        rows.append(
            {"name": item.label, "unit": item.unit, "deviation": value, "low": value - half,
             "high": value + half, "prior_sd": item.unit_sd}
        )  # fmt: skip
    return rows


def extended_model(diagnosis: TruckDiagnosis, base: str) -> str:
    """Return the text of extended_model.toml: the named cause as an effect of the base set."""
    assert diagnosis.verdict is not None
    (item,) = diagnosis.verdict.causes
    cause, own = item.fit.cause, interval(item)
    assert cause is not None
    source = f"diagnosed from {counted(len(diagnosis.shifts), 'shift')} of a truck's log"
    units = {p.name: p.unit for p in cause.effect.parameters}
    table = {
        name: Parameter(value, units[name], source)
        for name, value in cause.values(item.fit.size).items()
    }
    table[cause.parameter.name] = Parameter(own.value, own.unit, source, own.low, own.high)
    return model_file(
        f"the model {base} extended by what a truck's log shows", base,
        {f"effect.{cause.id}": table},
    )  # fmt: skip


def shifts_figure(diagnosis: TruckDiagnosis) -> Figure:
    """Return a shift of each kind: recorded, the healthy truck, the best explanation, residuals."""
    assert diagnosis.verdict is not None
    healthy, best = diagnosis.verdict.healthy, diagnosis.verdict.best
    models = [("healthy truck", healthy.fit, "before")]
    if best is not healthy:
        models.append((best.fit.name, best.fit, "after"))
    assert healthy.fit.per_shift is not None
    stacks: list[Stack] = []
    kinds: set[tuple[str, str]] = set()
    for k in np.argsort(-healthy.fit.per_shift).tolist():
        shift = diagnosis.shifts[k]
        if (shift.start, shift.end) in kinds or len(stacks) == 4:
            continue
        kinds.add((shift.start, shift.end))
        ms = MS * (shift.time_s - LEAD_S)
        lines = [Series("recorded", ms, MM * shift.position_m, "measured", "marked", width=2.0)]
        residuals = []
        for label, fit, role in models:
            assert fit.position_m is not None
            x = fit.position_m[k, : len(ms)]
            lines.append(Series(label, ms, MM * x, role, width=0.9))
            residuals.append(Series(label, ms, MM * (shift.position_m - x), role, width=0.8))
        panels = [
            Panel("position", "mm", lines, height=150),
            Panel("recorded - model", "mm", residuals, height=90, legend=False),
        ]
        title = f"{shift.start} to {shift.end}, {shift.begin_s:.2f} s of {Path(shift.source).name}"
        stacks.append(Stack("time from the first command, ms", panels, title, width=5.5))
    return Figure(stacks)


def write_files(
    diagnosis: TruckDiagnosis, values: dict[str, Any], folder: Path, model: str, command: str
) -> None:
    """Write report.html, its picture, and the extended model of a named cause."""
    if diagnosis.kind == "named":
        write_atomically(folder / "extended_model.toml", extended_model(diagnosis, model))
    pictures, groups = [], []
    tiles = [(str(len(diagnosis.shifts)), noun(len(diagnosis.shifts), "shift") + " judged")]
    rows: list[dict[str, Any]] = []
    if diagnosis.verdict is not None:
        figure = shifts_figure(diagnosis)
        caption = (
            "Shifts that the healthy truck fits worst, one of each kind: recorded pulses, the healthy "
            "truck with its own quantities fitted, and the best explanation."
        )
        alt = "Recorded and modelled positions of shifts, with residuals"
        pictures.append(Picture(save(figure, folder, "shifts"), alt, caption))
        groups = plots(figure)
        best = diagnosis.verdict.best.fit
        rows = [
            {"name": item.fit.name, "probability": item.probability,
             "behind": best.evidence - item.fit.evidence, "chi2": diagnosis.chi2(item)}
            for item in diagnosis.verdict.hypotheses
        ]  # fmt: skip
        shown = {item.fit.id: item for item in (diagnosis.verdict.healthy, diagnosis.verdict.best)}
        tiles += [
            (f"{diagnosis.chi2(item):.2f}", f"chi squared per number, {name}")
            for name, item in shown.items()
        ]
        sound = diagnosis.verdict.probabilities["healthy"]
        tiles.append((f"{sound:.2f}", "probability of a healthy truck"))
    head = Head(
        command="diagnose", name=values["campaign"], verdict=diagnosis.kind,
        good=diagnosis.kind == "consistent", tiles=tiles, again=command,
    )  # fmt: skip
    page = render(
        "truck_diagnosis.html", head, groups, values=values, causes=reported(diagnosis),
        pictures=pictures, hypotheses=rows,
    )  # fmt: skip
    write_atomically(folder / "report.html", page)
