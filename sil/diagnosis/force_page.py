"""report.html of a rig known by force and position: friction against speed, hypotheses tried.

Checked by: tests/unit/sil/diagnosis/test_force_rig.py, tests/browser/
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sil.campaign.campaign import Floats
from sil.diagnosis.force_rig import DETECTABILITY, TERMS, ForceDiagnosis, balance, gains
from sil.files.atomic import write_atomically
from sil.report.figure import Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render

DRAWN = 4000


def _models(found: ForceDiagnosis) -> list[tuple[str, Floats, str]]:
    """Return label, force without inertia [n] in N and colour of the measurement and of each model."""
    leader = found.leader
    plain, _target = balance(found.motion, found.mass_kg)
    whole, target = balance(found.motion, found.mass_kg, leader.names, leader.shapes)
    first = np.linalg.lstsq(plain, target, rcond=None)[0]
    second = np.linalg.lstsq(whole, target, rcond=None)[0]
    inertia = np.zeros(len(target)) if found.mass_kg is not None else plain[:, 3] * second[3]
    rows = [
        ("measured, without inertia", target - inertia, "measured"),
        ("Coulomb, viscous, offset", plain @ first - inertia, "before"),
    ]
    if leader.names:
        rows.append(("with " + " + ".join(leader.names), whole @ second - inertia, "after"))
    return rows


def _speed_figure(found: ForceDiagnosis) -> Figure:
    order = np.argsort(found.motion.speed_m_s, kind="stable")
    drawn = order[np.linspace(0, len(order) - 1, min(DRAWN, len(order))).astype(int)]
    speed = found.motion.speed_m_s[drawn]
    dots = [Series(label, speed, f[drawn], role, "dots") for label, f, role in _models(found)]
    return Figure([Stack("speed, m/s", [Panel("Force", "N", dots, height=320)])])


def _time_figure(found: ForceDiagnosis) -> Figure:
    motion = found.motion
    x = np.arange(len(motion.force_n)) / motion.rate_hz
    lines = [
        Series(label, x, force, role, dashed=role == "after")
        for label, force, role in _models(found)
    ]
    panels = [Panel("Force, without inertia", "N", lines, height=220)]
    for title, unit, values in (
        ("Speed", "m/s", motion.speed_m_s),
        ("Position", "m", motion.position_m),
    ):
        panels.append(Panel(title, unit, [Series("measured", x, values, "truth")], height=120))
    return Figure([Stack("time in motion, s", panels)])


def write_page(found: ForceDiagnosis, folder: Path, campaign: str) -> None:
    """Write report.html and its figure."""
    verdict = found.verdict
    causes = [] if found.doubts else found.causes()
    head = Head(
        command="diagnose",
        name=found.name,
        verdict=verdict,
        good=verdict == "consistent",
        tiles=[
            (f"{found.error(found.plain):.2%}", "relative force error, plain body"),
            (f"{found.over_noise(found.leader):.3g}", "residual over noise"),
            *((f"{cause.probability:.2f}", f"probability of {cause.id}") for cause in causes[:3]),
        ],
        again=f"opc4 diagnose {campaign}",
    )
    page = render(
        "force.html",
        head,
        plots(_time_figure(found), repeated=False),
        found=found,
        detectability=DETECTABILITY,
        causes=causes,
        picture=Picture(
            save(_speed_figure(found), folder, "force"),
            "Force against speed",
            "Driving force without inertia: measured, of the plain body, and with what is claimed.",
        ),
        rows=[(name, item, *gains(item, found.plain)) for name, item in found.singles.items()],
        units={name: term.unit for name, term in TERMS.items()},
    )
    write_atomically(folder / "report.html", page)
