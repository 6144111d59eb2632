"""From a slider of the live bench to the curves on the screen, compared with the run and the drawing alone."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from tests.browser.conftest import started
from tests.browser.test_live import Live, Page

MOVES = 60
NAME = "truck_into_gear_easy"


def measure() -> Iterator[str]:
    """Lines of the table; needs Chromium."""
    alone = []
    for number in range(12):
        changed = {"valve.D_fall": round(0.01 + 1e-4 * number, 4)}
        begin = time.perf_counter()
        run_in_memory(load_scenario.load(NAME, settings=changed))
        alone.append(1e3 * (time.perf_counter() - begin))
    with tempfile.TemporaryDirectory() as folder, started(Path(folder) / "profile") as browser:
        live = Live(Path(folder))
        page = Page(browser, f"{live.address}#%7B%22scenario%22%3A%22{NAME}%22%7D")
        page.wait(page.drawn)
        for move in range(MOVES + 5):
            page.after(lambda move=move: page.slide("valve.D_fall", 20 + move))  # type: ignore[misc]
        browser.execute_async_script("setTimeout(arguments[0], 500)")
        found = browser.execute_script("return window.opc4Latency")[5:]
        draw = browser.execute_script(
            "const t = performance.now(); const group = window.opc4Plots();"
            "for (let i = 0; i < 10; i++) window.dispatchEvent(new Event('beforeprint'));"
            "return (performance.now() - t) / 10 / Math.max(1, group.length)"
        )
        live.end()
    run_ms = statistics.median(alone[2:])
    median, late = statistics.median(found), statistics.quantiles(found, n=20)[-1]
    yield f"{NAME}, {len(found)} movements of one slider, Chromium without a screen"
    yield f"run in memory alone       {run_ms:7.1f} ms"
    yield f"drawing alone             {draw:7.1f} ms"
    yield f"slider to picture, median {median:7.1f} ms   {median / (run_ms + draw):5.2f} x run and drawing"
    yield f"slider to picture, 95 %   {late:7.1f} ms   {late / (run_ms + draw):5.2f} x"
