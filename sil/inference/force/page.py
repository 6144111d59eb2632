"""report.html of a rig known by force and position: what is wrong, the body, what was tried.

Checked by: tests/unit/sil/inference/force/test_diagnosis.py, tests/browser/
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sil.campaign.campaign import Floats
from sil.files.atomic import write_atomically
from sil.inference.force.diagnosis import DETECTABILITY, ForceDiagnosis
from sil.inference.force.fit import gain_in_errors
from sil.report.figure import Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render


def _models(diagnosis: ForceDiagnosis) -> list[tuple[str, Floats, str]]:
    """Return label, force without inertia [n] in N and colour of the measurement and of each model."""
    leader, bank = diagnosis.leader, diagnosis.bank
    mass = leader.value("mass_kg")[0] if "mass_kg" in leader.body else 0.0
    inertia = mass * diagnosis.record.raw.acceleration_m_s2[diagnosis.record.judged]
    rows = [
        ("measured, without inertia", bank.target - inertia, "measured"),
        ("Coulomb, viscous, offset", bank.model_n(diagnosis.plain) - inertia, "before"),
    ]
    if leader.groups:
        rows.append((f"with {leader.name}", bank.model_n(leader) - inertia, "after"))
    return rows


def _speed_figure(diagnosis: ForceDiagnosis) -> Figure:
    speeds = diagnosis.record.raw.speed_m_s[diagnosis.record.judged]
    order = np.argsort(speeds, kind="stable")
    drawn = order[np.linspace(0, len(order) - 1, min(4000, len(order))).astype(int)]
    models = _models(diagnosis)
    dots = [Series(label, speeds[drawn], f[drawn], role, "dots") for label, f, role in models]
    return Figure([Stack("speed, m/s", [Panel("Force", diagnosis.unit, dots, height=320)])])


def _time_figure(diagnosis: ForceDiagnosis) -> Figure:
    record, bank, unit = diagnosis.record, diagnosis.bank, diagnosis.unit
    rows = np.flatnonzero(record.judged)
    x = np.asarray(rows * record.step_s, dtype=np.float64)
    lines = [
        Series(label, x, force, role, dashed=role == "after")
        for label, force, role in _models(diagnosis)
    ]
    panels = [Panel("Force, without inertia", unit, lines, height=220)]
    residual = bank.target - bank.model_n(diagnosis.leader)
    signals: list[tuple[str, str, Floats]] = [
        ("Residual, of what is claimed", unit, residual),
        ("Speed", "m/s", record.raw.speed_m_s[rows]),
        ("Position", "m", record.raw.position_m[rows]),
    ]
    if record.raw.pressure_pa is not None:
        signals.append(("Pressure", "Pa", record.raw.pressure_pa[rows]))
    for title, axis_unit, values in signals:
        line = Series("measured", x, values, "truth")
        panels.append(Panel(title, axis_unit, [line], height=120))
    return Figure([Stack("time, s", panels)])


def write_page(diagnosis: ForceDiagnosis, folder: Path, campaign: str) -> None:
    """Write report.html and its figure."""
    verdict = diagnosis.verdict
    causes = [] if diagnosis.doubts else diagnosis.causes()
    tiles = [
        (f"{diagnosis.plain.over_noise:.3g}", "residual over noise, plain body"),
        (f"{diagnosis.leader.over_noise:.3g}", "of what is claimed"),
        (f"{diagnosis.error(diagnosis.leader):.2%}", "of the driving force"),
        *((f"{cause.probability:.2f}", f"probability of {cause.id}") for cause in causes[:3]),
    ]
    good, again = verdict == "consistent", f"opc4 diagnose {campaign}"
    page = render(
        "force.html",
        Head("diagnose", diagnosis.record.name, verdict, good, tiles, again),
        plots(_time_figure(diagnosis), repeated=False),
        diagnosis=diagnosis,
        detectability=DETECTABILITY,
        causes=causes,
        refused=diagnosis.refused(),
        picture=Picture(
            save(_speed_figure(diagnosis), folder, "force"),
            "Force against speed",
            "Driving force without inertia: measured, of the plain body, and with what is claimed.",
        ),
        rows=[(item, gain_in_errors(item, diagnosis.plain)) for item in diagnosis.judged[:12]],
    )
    write_atomically(folder / "report.html", page)
