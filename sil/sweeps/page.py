"""The page of a study: its question, the table of groups, the pictures; offline, in one file."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sil.sweeps.pictures import read_metrics
from sil.sweeps.study import LoadedStudy

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:1rem auto;padding:0 1rem}
img{max-width:100%;height:auto;background:#fff}table{border-collapse:collapse;display:block;overflow-x:auto}
td,th{border:1px solid #bbb;padding:.2rem .5rem;text-align:right}td:first-child{text-align:left}
@media(prefers-color-scheme:dark){body{background:#15171a;color:#e6e6e6}}
"""


def page(study: LoadedStudy, told: dict[str, Any], pictures: Sequence[Path]) -> str:
    """The report as HTML text."""
    shown = ["shift_time_s", "arrival_s", "impact_speed_m_s", "impact_energy_j"]
    if study.study.kind != "runs":
        shown = read_metrics(study)
    rows = []
    for name, entry in told["groups"].items():
        cells = [html.escape(name or study.study.name), str(entry["rows"])]
        for metric in shown:
            if metric in entry:
                figures = entry[metric]
                cells.append(f"{metric}: {figures['median']:.4g} (worst {figures['max']:.4g})")
        cells.append(f"failed {100 * entry['failed_share']:.1f} %")
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    images = "".join(
        f'<p><img alt="{html.escape(path.stem)}" src="data:image/png;base64,'
        f'{base64.b64encode(path.read_bytes()).decode()}"></p>'
        for path in pictures
    )
    sentences = "".join(f"<p>{html.escape(line)}</p>" for line in told.get("kept", ()))
    again = ""
    if study.study.kind == "runs" and study.study.scenario is not None:
        again = (
            f"<p>Every row again by itself: <code>opc4 run {html.escape(study.study.scenario)} "
            "--set ...</code> with the values of its line in results.csv.</p>"
        )
    title = html.escape(study.study.name)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width,initial-scale=1"><title>{title}</title><style>{STYLE}</style>'
        f"<h1>{title}</h1><p>{html.escape(study.study.description)}</p>"
        f"{sentences}{images}<table>{''.join(rows)}</table>"
        f"{again}</html>\n"
    )
