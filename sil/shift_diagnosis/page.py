"""diagnosis.json, extended_model.toml and report.html of a truck's shifts.

Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import Parameter, load_actuator
from sil.files.atomic import write_atomically
from sil.files.progress import Progress
from sil.files.quantity import counted, noun
from sil.inference.headline import headline, seen_sentence
from sil.inference.model_file import model_file
from sil.inference.report import Cause as Reported
from sil.inference.report import Interval, diagnosis_json
from sil.inference.thresholds import UNNAMED
from sil.j1939.mapping import SignalMapping
from sil.report.figure import MM, MS, Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.shift_diagnosis.judge import judge_shifts
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.shifts import FAILED, LEAD_S, RecordedShift, shifts_of
from sil.shift_diagnosis.verdict import EXPLAINED, Detectable, Judged, ShiftDiagnosis, with_failures

FALSE_ALARM_BASIS: Final = (
    "posterior of a healthy truck at most 0.01, with priors on what differs between healthy trucks; "
    "measured on drawn truck logs (docs, truck-diagnosis)"
)
ASSUMED: Final = (
    "The actuator is that of the model within the tolerances of its section repeatability.",
    "Gearbox mass, linkage friction, barriers of the teeth, cone and supply are unknown within wide priors.",
    "Pulses are reported 1.5 ms after their start, and every frame as soon as the bus is free.",
    "PlantMotion and PlantPressures are not used: a truck's bus does not have them.",
)
MEASURE: Final = {
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
UNITS: Final = {"latency": ("s", "s"), "offset": ("m", "m"), "mesh": ("N", "N"), "pull": ("N", "N")}
NAMES: Final = {
    "friction": "friction of stay and pistons",
    "rise": "opening delay",
    "fall": "closing delay",
    "flow_in": "charge flow",
    "flow_out": "discharge flow",
    "volume_a": "volume of chambers B, F",
    "volume_b": "volume of chamber N",
    "supply": "supply pressure",
    "linkage": "friction of the linkage",
    "mass": "mass of the gearbox",
    "mesh": "barrier into gear",
    "pull": "barrier out of gear",
    "cone_B": "impulse per speed difference, backward",
    "cone_F": "impulse per speed difference, forward",
    "latency": "way of a pulse to the log",
    "offset": "offset of the position",
    "gain": "gain of the position",
}


def reported(found: ShiftDiagnosis) -> list[Reported]:
    """Return the causes as diagnosis.json holds them, the most probable first."""
    causes = []
    for item in found.named:
        cause = item.fit.cause
        assert cause is not None
        text = f"{cause.effect.what}: {cause.parameter.name} {interval(item)}"
        behind = found.healthy.cost - item.cost
        text += f"; over {counted(len(found.shifts), 'shift')} it gains {behind:.1f} in log evidence, and chi "
        text += f"squared per number falls from {found.healthy.chi2:.2f} to {item.chi2:.2f}"
        ids = {other.id for other in found.named}
        if alike := [name for name in alike_of(found, cause) if name in ids]:
            text += f"; the bus cannot distinguish it from {', '.join(alike)}"
        effect = cause.effect
        own = {cause.parameter.name: interval(item)}
        causes.append(
            Reported(effect.id, effect.cause_class, found.probabilities[effect.id], own, text)
        )
    return sorted(causes, key=lambda cause: -cause.probability)


def interval(item: Judged) -> Interval:
    """Return the 95 % interval of a cause's parameter, in its unit."""
    cause, (size, deviation) = item.fit.cause, item.size
    assert cause is not None
    ends = [cause.value(size + k * deviation) for k in (0.0, -1.96, 1.96)]
    return Interval(ends[0], min(ends[1:]), max(ends[1:]), cause.parameter.unit)


def alike_of(found: ShiftDiagnosis, cause: Cause) -> tuple[str, ...]:
    """Return the ids of the causes that these shifts cannot distinguish from one.

    Whichever of two is tested against the other: one of them might be noticed at no size.
    """
    own = next((item.alike for item in found.detectable if item.cause.name == cause.name), ())
    others = [item.cause.effect.id for item in found.detectable if cause.effect.id in item.alike]
    return tuple(dict.fromkeys((*own, *others)))


def noticed_of(found: ShiftDiagnosis) -> list[Detectable]:
    """Return what these shifts would show, each cause in its first variant."""
    first: dict[str, Detectable] = {}
    for item in found.detectable:
        first.setdefault(item.cause.effect.id, item)
    return [item for item in first.values() if item.size is not None]


def groups_of(found: ShiftDiagnosis) -> list[dict[str, Any]]:
    """Return each group of causes that the bus cannot separate, with what would separate it."""
    groups: dict[frozenset[str], dict[str, Any]] = {}
    classes = {item.cause.effect.id: item.cause.effect.cause_class for item in found.detectable}
    for item in found.detectable:
        ids = frozenset((item.cause.effect.id, *item.alike))
        if len(ids) > 1 and ids not in groups:
            kinds = sorted({classes[name] for name in ids})
            measure = [MEASURE[kind] for kind in kinds if kind in MEASURE]
            groups[ids] = {"causes": sorted(ids), "of": item.cause.name, "measure": measure}
    return list(groups.values())


def as_json(found: ShiftDiagnosis, logs: list[str], skipped: dict[str, int]) -> dict[str, Any]:
    """Return the object of diagnosis.json."""
    causes = reported(found)
    concerned = {cause.id for cause in causes}
    rivals = [g for g in groups_of(found) if concerned.intersection(g["causes"])]
    findings = list(found.findings) + [
        f"{counted(n, 'shift')} {why} left out" for why, n in skipped.items()
    ]
    if found.judged:
        findings.append(
            "on a gearbox" if found.mounted else "on a rig without gearbox, by its mass"
        )
    shown = found.judged and {
        "healthy": found.healthy.chi2, "best": found.best.chi2, "limit": EXPLAINED,
    }  # fmt: skip
    return diagnosis_json(
        Path(logs[0]).name + (f" and {len(logs) - 1} more" if len(logs) > 1 else ""),
        found.verdict,
        causes,
        findings,
        FALSE_ALARM_BASIS,
        headline=headline_of(found, causes),
        rivals=[group["causes"] for group in rivals],
        extended_model="extended_model.toml" if found.verdict == "named" else None,
        logs=logs,
        shifts=len(found.shifts),
        noise_m=found.noise.position_m,
        scatter=found.noise.scatter,
        probabilities={name: round(p, 4) for name, p in found.probabilities.items()},
        chi2_per_number=shown or None,
        groups=groups_of(found),
        detectable=[
            {
                "id": i.cause.effect.id,
                "parameter": i.cause.parameter.name,
                "size": i.value,
                "unit": i.cause.parameter.unit,
                "alike": list(i.alike),
            }
            for i in noticed_of(found)
        ],
        truck=truck_rows(found),
        assumed=list(ASSUMED),
    )


def headline_of(found: ShiftDiagnosis, causes: list[Reported]) -> str:
    """Return the one sentence that a reader needs first."""
    first = found.findings[0] if found.findings else ""
    if found.verdict == UNNAMED:
        return f"Something is wrong: {first}; no cause of the catalogue explains it."
    seen = seen_sentence(
        (i.cause.effect.id, i.value, i.cause.parameter.neutral, i.cause.parameter.unit)
        for i in noticed_of(found)
        if i.value is not None and not i.cause.is_narrowing
    )
    return headline(found.verdict, causes, seen, first)


def truck_rows(found: ShiftDiagnosis) -> list[dict[str, Any]]:
    """Return the truck's own quantities under the best hypothesis, with 95 % intervals."""
    if not found.judged:
        return []
    fit = found.best.fit
    deviation = np.sqrt(np.diag(fit.covariance))
    rows = []
    for k, name in enumerate(fit.linear.names):
        prior = found.priors[name]
        value, sd = float(fit.estimate[k]) * prior, float(deviation[k]) * prior
        unit = UNITS.get(name, ("s", "s") if name in ("rise", "fall") else ("-", "share"))[0]
        rows.append(
            {"name": NAMES[name], "unit": unit, "deviation": value, "low": value - 1.96 * sd,
             "high": value + 1.96 * sd, "prior_sd": prior}
        )  # fmt: skip
    return rows


def extended_model(found: ShiftDiagnosis, base: str) -> str:
    """Return the text of extended_model.toml: the named cause as an effect of the base set."""
    (item,) = found.named
    cause = item.fit.cause
    assert cause is not None
    own = interval(item)
    source = f"diagnosed from {counted(len(found.shifts), 'shift')} of a truck's log"
    units = {p.name: p.unit for p in cause.effect.parameters}
    table = {
        name: Parameter(value, units[name], source)
        for name, value in cause.values(item.size[0]).items()
    }
    table[cause.parameter.name] = Parameter(own.value, own.unit, source, own.low, own.high)
    return model_file(
        f"the model {base} extended by what a truck's log shows", base,
        {f"effect.{cause.effect.id}": table},
    )  # fmt: skip


def shifts_figure(found: ShiftDiagnosis) -> Figure:
    """Return a shift of each kind: recorded, the healthy truck, the best explanation, residuals."""
    stacks: list[Stack] = []
    kinds: set[tuple[str, str]] = set()
    before = found.healthy.fit.linear
    models = [("healthy truck", before, "before")]
    if found.best is not found.healthy:
        models.append((found.best.name, found.best.fit.linear, "after"))
    order = np.argsort(-before.misfit)
    for k in order.tolist():
        shift = found.shifts[k]
        if (shift.start, shift.end) in kinds or len(stacks) == 4:
            continue
        kinds.add((shift.start, shift.end))
        ms = MS * (shift.time_s - LEAD_S)
        lines = [Series("recorded", ms, MM * shift.position_m, "measured", "marked", width=2.0)]
        residuals = []
        for label, linear, role in models:
            rest = linear.residuals[k]
            lines.append(Series(label, ms, MM * (shift.position_m - rest), role, width=0.9))
            residuals.append(Series(label, ms, MM * rest, role, width=0.8))
        panels = [
            Panel("position", "mm", lines, height=150),
            Panel("recorded - model", "mm", residuals, height=90, legend=False),
        ]
        title = f"{shift.start} to {shift.end}, {shift.begin_s:.2f} s of {Path(shift.source).name}"
        stacks.append(Stack("time from the first command, ms", panels, title, width=5.5))
    return Figure(stacks)


def diagnosed(
    logs: Sequence[str],
    model: str,
    layout: tuple[str | None, str | None],
    skipped: Counter[str],
    progress: Progress,
    workers: int = 1,
) -> ShiftDiagnosis:
    """Read the shifts of one truck's logs and judge them; `skipped` counts those left out.

    layout: mapping file and DBC of another layout.  Raises InputError for bad files.
    """
    parameters = load_actuator(model)
    mapping = SignalMapping(*layout) if any(layout) else None
    shifts: dict[tuple[object, ...], RecordedShift] = {}
    broken: list[str] = []
    read = set[str]()
    for path in logs:
        if (real := os.path.realpath(path)) in read:
            raise InputError(f"{path}: given twice; expected each log once")
        read.add(real)
        faults: list[str] = []
        for shift in shifts_of(path, parameters, mapping, skipped, faults):
            what = shift.begin_s, shift.commands, shift.position_m.tobytes()
            if shifts.setdefault(what, shift) is not shift:
                skipped["that an earlier log holds, too,"] += 1
        broken += [f"{path}: {fault}" for fault in faults]
    found = judge_shifts(list(shifts.values()), parameters, progress, workers)
    found = with_failures(found, skipped.pop(FAILED, 0))
    return replace(found, findings=(*found.findings, *broken))


def write_files(
    found: ShiftDiagnosis, values: dict[str, Any], folder: Path, model: str, command: str
) -> None:
    """Write report.html, its picture, and the extended model of a named cause."""
    if found.verdict == "named":
        write_atomically(folder / "extended_model.toml", extended_model(found, model))
    pictures, groups = [], []
    if found.judged:
        figure = shifts_figure(found)
        caption = (
            "Shifts that the healthy truck fits worst, one of each kind: recorded pulses, the healthy "
            "truck with its own quantities fitted, and the best explanation."
        )
        alt = "Recorded and modelled positions of shifts, with residuals"
        pictures.append(Picture(save(figure, folder, "shifts"), alt, caption))
        groups = plots(figure)
    tiles = [(str(len(found.shifts)), noun(len(found.shifts), "shift") + " judged")]
    if found.judged:
        shown = {item.id: item for item in (found.healthy, found.best)}
        tiles += [
            (f"{it.chi2:.2f}", f"chi squared per number, {name}") for name, it in shown.items()
        ]
        tiles.append((f"{found.probabilities['healthy']:.2f}", "probability of a healthy truck"))
    head = Head(
        command="diagnose", name=values["campaign"], verdict=found.verdict,
        good=found.verdict == "consistent", tiles=tiles, again=command,
    )  # fmt: skip
    page = render(
        "shift_diagnosis.html", head, groups, values=values, causes=reported(found),
        pictures=pictures, judged=found.judged,
    )  # fmt: skip
    write_atomically(folder / "report.html", page)
