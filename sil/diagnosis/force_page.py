"""report.html of a rig known by force and position: friction against speed, hypotheses tried.

Checked by: tests/unit/sil/diagnosis/test_force_rig.py, tests/browser/
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sil.diagnosis.force_rig import TERMS, ForceDiagnosis, base, gains
from sil.diagnosis.pictures import AFTER, BEFORE, MEASURED, new_figure
from sil.files.atomic import write_atomically
from sil.report.figures import save
from sil.report.interactive import Group, Panel, Series, plots
from sil.report.shell import Head, Picture, render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
DRAWN = 4000
PLAIN = "Coulomb, viscous, offset"


def forces(found: ForceDiagnosis) -> tuple[Floats, Floats, Floats]:
    """Force [N] without inertia: measured, of the plain body, with the causes claimed."""
    motion = found.motion
    plain, left = base(motion, found.mass_kg)
    added = [
        TERMS[n].feature(motion, s)
        for n, s in zip(found.leader.names, found.leader.shapes, strict=True)
    ]
    whole = np.column_stack([plain, *added])
    first = np.linalg.lstsq(plain, left, rcond=None)[0]
    second = np.linalg.lstsq(whole, left, rcond=None)[0]
    inertia = plain[:, 3] * second[3] if plain.shape[1] > 3 else np.zeros(len(left))
    return left - inertia, plain @ first - inertia, whole @ second - inertia


def picture(found: ForceDiagnosis) -> Figure:
    """Force without inertia against speed: measured, plain friction, with the causes claimed."""
    measured, plain, whole = forces(found)
    shown = np.linspace(0, len(measured) - 1, min(DRAWN, len(measured))).astype(int)
    figure = new_figure(8.0, 4.5)
    axes = figure.add_subplot()
    speed = found.motion.speed_m_s[shown]
    for values, colour, label in (
        (measured, MEASURED, "measured, inertia taken off"),
        (plain, BEFORE, PLAIN),
        (whole, AFTER, "with " + " + ".join(found.leader.names)),
    ):
        if found.leader.names or colour != AFTER:
            axes.plot(speed, values[shown], ".", markersize=2, color=colour, label=label)
    axes.set_xlabel("speed [m/s]")
    axes.set_ylabel("force [N]")
    axes.legend(markerscale=5)
    return figure


def force_plots(found: ForceDiagnosis) -> Group:
    """Force, speed and position over the time in motion."""
    motion = found.motion
    measured, plain, whole = forces(found)
    lines = [Series("measured", measured, "measured"), Series(PLAIN, plain, "before")]
    if found.leader.names:
        name = "with " + " + ".join(found.leader.names)
        lines.append(Series(name, whole, "after", dashed=True))
    time_s = np.arange(len(measured)) / motion.rate_hz
    return plots(
        "time in motion, s",
        time_s,
        [
            Panel("Force, inertia taken off", "N", lines, 220),
            Panel("Speed", "m/s", [Series("measured", motion.speed_m_s, "measured")], 120),
            Panel("Position", "m", [Series("measured", motion.position_m, "measured")], 120),
        ],
    )


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
        [force_plots(found)],
        detectability=plain["detectability"],
        causes=plain["causes"],
        picture=Picture(
            save(picture(found), folder, "force"),
            "Force against speed",
            "Driving force without inertia: measured, of the plain body, and with what is claimed.",
        ),
        plain_error=f"{found.error(found.plain):.2%}",
        rows=rows,
    )
    write_atomically(folder / "report.html", page)
