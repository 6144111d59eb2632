"""The notebook as a reader runs it: every cell, in order, in a folder of its own."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from sil.api import run
from tests.docs.pages import DOCS

CELLS = [
    "".join(cell["source"])
    for cell in json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    if cell["cell_type"] == "code"
]


@pytest.mark.slow
def test_every_cell_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    names: dict[str, Any] = {}
    for cell in CELLS:
        exec(compile(cell, "notebook", "exec"), names)
    plots = [names["plt"].figure(number) for number in names["plt"].get_fignums()]
    assert len(plots) == 3 and all(plot.axes[0].lines for plot in plots)
    assert names["found"].verdict.kind == "named" and names["cause"].id == "valve_open_delay"
    assert names["delay_s"].value == pytest.approx(0.005, abs=2e-4)
    for name, word in (
        ("today", "shift_time_s"),
        ("swept", "9 bar"),
        ("found", "valve_open_delay"),
    ):
        shown = names[name]._repr_html_()
        assert shown.startswith("<p>") and word in shown and "<script" not in shown
    names["plt"].close("all")


def test_results_become_tables_of_pandas() -> None:
    pandas = importlib.import_module("pandas")
    done = run("lab_n_b")
    table = done.to_pandas()
    assert isinstance(table, pandas.DataFrame) and table.index.name == "time_s"
    assert np.array_equal(table["position_m"].to_numpy(), done.signals["position_m"])
    assert "&lt;" not in done._repr_html_() and "met" in done._repr_html_()
