"""Writes the files of `opc4 example logger`: `python -m tests.support.logger_campaign sil/examples/logger`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from plant.parameters import Parameter, ParameterSet, load
from tests.support.made_campaign import made

REGULATOR_PA = (8e5, 8e5, 6.5e5, 6.5e5, 5e5, 5e5)  # gauge
KINDS = tuple(
    (kind, gauge_pa + 101325.0)
    for kind, gauge_pa in zip(("N-B", "B-N", "N-F", "F-N", "N-B", "B-N"), REGULATOR_PA, strict=True)
)
HEAD = """Messung 12;;
Zeit;Weg;Druck B;Druck N;Druck F;Ventil B;Ventil N;Ventil F;Temp
ms;mm;bar;bar;bar;V;V;V;°C
"""


def write(folder: Path, rows_apart: int = 5) -> None:
    """Write strokes whose valves open 4 ms late: ms, mm, gauge bar, volts, decimal comma."""
    base = load()
    late = {"valve_open_delay": {"delay_s": Parameter(0.004, "s", "hidden in the example")}}
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        campaign = made(
            Path(name), ParameterSet(base.name, base.entries, late), seed=7, count=6, kinds=KINDS
        )
        for number, stroke in enumerate(campaign.strokes, 1):
            rows = np.loadtxt(Path(name) / stroke.file, delimiter=",", skiprows=1)[::rows_apart]
            (on_s, valve, _), (off_s, _, _) = stroke.conditions.commands
            lines = []
            for time_s, position_m, *pressures_pa in rows[:, :5]:
                volts = [24.0 * (c == valve and on_s <= time_s < off_s) for c in "BNF"]
                gauge = [f"{1e-5 * (p - campaign.atmosphere_pa):.4f}" for p in pressures_pa]
                cells = [f"{1e3 * time_s:.1f}", f"{1e3 * position_m:.3f}", *gauge]
                cells += [f"{v:.1f}" for v in volts] + ["20.0"]
                lines.append(";".join(cells).replace(".", ",") + "\n")
            (folder / f"Messung_{number}.csv").write_text(HEAD + "".join(lines), encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
