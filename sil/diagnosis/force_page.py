"""report.html of a rig known by force and position: friction against speed, hypotheses tried.

Checked by: tests/unit/sil/diagnosis/test_force_rig.py
"""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import numpy as np

from .force_rig import UNITS, ForceDiagnosis, base, feature, gains
from .pictures import AFTER, BEFORE, MEASURED, figure_bytes, new_figure

DRAWN = 4000


def picture(found: ForceDiagnosis) -> bytes:
    """Force without inertia against speed: measured, plain friction, with the causes claimed."""
    motion = found.motion
    plain, left = base(motion, found.mass_kg)
    added = [
        feature(n, s, motion) for n, s in zip(found.leader.names, found.leader.shapes, strict=True)
    ]
    whole = np.column_stack([plain, *added])
    first = np.linalg.lstsq(plain, left, rcond=None)[0]
    second = np.linalg.lstsq(whole, left, rcond=None)[0]
    inertia = plain[:, 3] * second[3] if plain.shape[1] > 3 else np.zeros(len(left))
    shown = np.linspace(0, len(left) - 1, min(DRAWN, len(left))).astype(int)
    figure = new_figure(8.0, 4.5)
    axes = figure.add_subplot()
    speed = motion.speed_m_s[shown]
    for values, colour, label in (
        (left - inertia, MEASURED, "measured, inertia taken off"),
        (plain @ first - inertia, BEFORE, "Coulomb, viscous, offset"),
        (whole @ second - inertia, AFTER, "with " + " + ".join(found.leader.names)),
    ):
        if found.leader.names or colour != AFTER:
            axes.plot(speed, values[shown], ".", markersize=2, color=colour, label=label)
    axes.set_xlabel("speed [m/s]")
    axes.set_ylabel("force [N]")
    axes.legend(markerscale=5)
    return figure_bytes(figure)


def write_page(found: ForceDiagnosis, path: Path, campaign: str) -> None:
    """Write the page."""
    plain = found.as_json()
    rows = []
    for name, item in found.singles.items():
        taken, sure = gains(item, found.plain)
        why = found.refused.get(name, "stands")
        rows.append(
            f"<tr><td>{name}</td><td>{item.values[0]:.3g} {UNITS[name][1]}</td>"
            f"<td>{found.error(item):.2%}</td><td>{taken:.1%}</td><td>{sure:.1f}</td>"
            f"<td>{escape(why)}</td></tr>"
        )
    causes = "".join(
        f"<li><b>{c['id']}</b> {c['probability']:.2f}: {escape(c['evidence'])}</li>"
        for c in plain["causes"]
    )
    image = base64.b64encode(picture(found)).decode()
    path.write_text(
        "<!doctype html><meta charset='utf-8'>"
        f"<title>{escape(found.name)}</title>"
        "<style>body{font:15px sans-serif;max-width:60em;margin:2em auto}"
        "td,th{padding:.2em .8em;text-align:left}</style>"
        f"<h1>{escape(found.name)}: {plain['verdict']}</h1><ul>{causes}</ul>"
        f"<p>{escape(plain['detectability'])}</p>"
        f"<img alt='force against speed' src='data:image/png;base64,{image}'>"
        f"<h2>Tried alone</h2><p>Relative force error of the plain body: "
        f"{found.error(found.plain):.2%}</p>"
        "<table><tr><th>cause</th><th>amount</th><th>relative error</th><th>squares taken</th>"
        f"<th>standard errors</th><th></th></tr>{''.join(rows)}</table>"
        f"<p><code>opc4 diagnose {escape(campaign)}</code></p>\n",
        encoding="utf-8",
    )
