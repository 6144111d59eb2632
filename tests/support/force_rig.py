"""Made measurements of a rig = "force", and their diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sil.inference.force.diagnosis import ForceDiagnosis, diagnose_motion
from sil.inference.force.record import read_motion


def diagnose_force(path: Path) -> ForceDiagnosis:
    """Return the diagnosis of the campaign in a folder."""
    return diagnose_motion(read_motion(path))


HEAD = """name = "bench"
rig = "force"
sample_rate_hz = 500.0
[columns]
position_m = { column = "x_mm", scale = 0.001 }
force_n = "f"
"""


def rig(
    folder: Path,
    *,
    faster_n_s_m: float = 0.0,
    stribeck_n: float = 0.0,
    per_pa: float = 0.0,
    head: str = HEAD,
    seed: int = 3,
) -> Path:
    """A 20 kg body on two sines; extra friction by direction, Stribeck fall, or pressure."""
    rng = np.random.default_rng(seed)
    t = np.arange(10000) / 500.0
    x = 0.1 * np.sin(2.1 * t) + 0.04 * np.sin(5.7 * t)
    v = 0.21 * np.cos(2.1 * t) + 0.228 * np.cos(5.7 * t)
    a = -0.441 * np.sin(2.1 * t) - 1.2996 * np.sin(5.7 * t)
    p = 3e5 + 2e5 * np.sign(np.sin(0.5 * t))
    s = np.sign(v)
    f = 20.0 * a + 15.0 * s + 80.0 * v + 2.0
    f += faster_n_s_m * np.abs(v) + stribeck_n * s * np.exp(-np.abs(v) / 0.08) + per_pa * p * s
    f += rng.normal(0.0, 1.0, len(t))
    folder.mkdir()
    table = np.column_stack([t, 1e3 * x + rng.normal(0.0, 1e-3, len(t)), f, p])
    np.savetxt(
        folder / "a.csv", table, "%.6f", ",", header="time_s,x_mm,f,pressure_pa", comments=""
    )
    (folder / "campaign.toml").write_text(head + '[[stroke]]\nfile = "a.csv"\n', encoding="utf-8")
    return folder


def changed(folder: Path, column: str, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Change one column of a rig's record."""
    file = folder / "a.csv"
    names = file.read_text(encoding="utf-8").splitlines()[0].split(",")
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    table[:, names.index(column)] = change(table[:, names.index(column)])
    np.savetxt(file, table, "%.6f", ",", header=",".join(names), comments="")
    return folder


def written(folder: Path, body: str, **columns: np.ndarray) -> Path:
    """A campaign of columns at 500 Hz with this [body]."""
    folder.mkdir()
    t = np.arange(len(columns["position_m"])) / 500.0
    table = np.column_stack([t, *columns.values()])
    header = ",".join(["time_s", *columns])
    np.savetxt(folder / "a.csv", table, "%.9g", ",", header=header, comments="")
    text = f'name = "a"\nrig = "force"\nsample_rate_hz = 500.0\n[body]\n{body}\n'
    (folder / "campaign.toml").write_text(f'{text}[[stroke]]\nfile = "a.csv"\n', encoding="utf-8")
    return folder
