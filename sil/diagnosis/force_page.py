"""report.html of a rig known by force and position: friction against speed, hypotheses tried.

Checked by: tests/unit/sil/diagnosis/test_force_rig.py, tests/browser/
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sil.diagnosis.force_rig import TERMS, ForceDiagnosis, base, gains
from sil.files.atomic import write_atomically
from sil.report.figure import Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render

Floats = NDArray[np.float64]
DRAWN = 4000
PLAIN = "Coulomb, viscous, offset"


def forces(found: ForceDiagnosis) -> tuple[Floats, Floats, Floats]:
    """Return force without inertia, each [n] in N: measured, of the plain body, with the causes."""
    motion = found.motion
    plain, target = base(motion, found.mass_kg)
    added = [
        TERMS[n].feature(motion, s)
        for n, s in zip(found.leader.names, found.leader.shapes, strict=True)
    ]
    whole = np.column_stack([plain, *added])
    first = np.linalg.lstsq(plain, target, rcond=None)[0]
    second = np.linalg.lstsq(whole, target, rcond=None)[0]
    inertia = plain[:, 3] * second[3] if plain.shape[1] > 3 else np.zeros(len(target))
    return target - inertia, plain @ first - inertia, whole @ second - inertia


def models(found: ForceDiagnosis) -> list[tuple[str, Floats, str]]:
    """Return label, force without inertia [n] in N and colour of the measurement and of each model."""
    measured, plain, whole = forces(found)
    rows = [("measured, without inertia", measured, "measured"), (PLAIN, plain, "before")]
    if found.leader.names:
        rows.append(("with " + " + ".join(found.leader.names), whole, "after"))
    return rows


def speed_figure(found: ForceDiagnosis) -> Figure:
    """Return the force without inertia against speed."""
    order = np.argsort(found.motion.speed_m_s, kind="stable")
    drawn = order[np.linspace(0, len(order) - 1, min(DRAWN, len(order))).astype(int)]
    speed = found.motion.speed_m_s[drawn]
    dots = [Series(label, speed, f[drawn], role, "dots") for label, f, role in models(found)]
    return Figure([Stack("speed, m/s", [Panel("Force", "N", dots, height=320)])])


def time_figure(found: ForceDiagnosis) -> Figure:
    """Return force, speed and position over the time in motion."""
    motion = found.motion
    x = np.arange(len(motion.force_n)) / motion.rate_hz
    lines = [
        Series(label, x, force, role, dashed=role == "after")
        for label, force, role in models(found)
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
    plain = found.as_json()
    rows = []
    for name, item in found.singles.items():
        taken, sure = gains(item, found.plain)
        rows.append(
            {
                "name": name,
                "amount": f"{item.values[0]:.3g} {TERMS[name].unit}",
                "error": f"{found.error(item):.2%}",
                "taken": f"{taken:.1%}",
                "sure": f"{sure:.1f}",
                "why": found.refused.get(name, "accepted"),
            }
        )
    head = Head(
        command="diagnose",
        name=found.name,
        verdict=plain["verdict"],
        good=plain["verdict"] == "consistent",
        tiles=[
            (f"{found.error(found.plain):.2%}", "relative force error, plain body"),
            (f"{found.over_noise(found.leader):.3g}", "residual over noise"),
            *(
                (f"{c['probability']:.2f}", f"probability of {c['id']}")
                for c in plain["causes"][:3]
            ),
        ],
        again=f"opc4 diagnose {campaign}",
    )
    page = render(
        "force.html",
        head,
        plots(time_figure(found), repeated=False),
        detectability=plain["detectability"],
        causes=plain["causes"],
        picture=Picture(
            save(speed_figure(found), folder, "force"),
            "Force against speed",
            "Driving force without inertia: measured, of the plain body, and with what is claimed.",
        ),
        findings=plain["findings"] if found.doubts else [],
        body=[
            (name, f"{v['value']:.4g} {v['unit']}", f"{v['low']:.4g} to {v['high']:.4g}")
            for name, v in plain["body"].items()
        ],
        plain_error=f"{found.error(found.plain):.2%}",
        rows=rows,
    )
    write_atomically(folder / "report.html", page)
