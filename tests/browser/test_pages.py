"""The pages in a real browser: they open without a complaint, draw, zoom together, fit a phone."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

from sil.cli import main

pytestmark = pytest.mark.browser

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-quic", "--hide-scrollbars",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("run") / "run"
    assert main(["run", "full_shift", "--out", str(folder)]) == 0
    return (folder / "report.html").as_uri()


def ranges(browser: Any) -> list[list[float]]:
    found: list[list[float]] = browser.execute_script(
        "return window.opc4Plots.map(c => [c.scales.x.min, c.scales.x.max])"
    )
    return found


def opened(browser: Any, page: str, width: int = 1200, height: int = 900) -> None:
    browser.set_window_size(width, height)
    browser.get(page)


def test_it_opens_without_a_complaint_and_asks_the_network_for_nothing(browser: Any, page: str) -> None:
    opened(browser, page)
    assert browser.get_log("browser") == []
    assert "full_shift" in browser.title
    asked = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in asked if not name.startswith("data:")] == []


def test_every_panel_is_drawn(browser: Any, page: str) -> None:
    opened(browser, page)
    inked = browser.execute_script(
        """return window.opc4Plots.map(c => {
             const d = c.ctx.getImageData(0, 0, c.ctx.canvas.width, c.ctx.canvas.height).data;
             let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; })"""
    )
    assert len(inked) == 5 and min(inked) > 2000


def test_a_drag_zooms_all_panels_and_a_double_click_shows_everything(browser: Any, page: str) -> None:
    opened(browser, page)
    whole = ranges(browser)
    assert len({tuple(r) for r in whole}) == 1
    over = browser.find_elements(By.CSS_SELECTOR, ".u-over")[1]
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", over)
    wide = over.size["width"]
    start = ActionChains(browser).move_to_element_with_offset(over, -wide // 4, 0)
    start.click_and_hold().move_by_offset(wide // 4, 0).release().perform()
    zoomed = ranges(browser)
    assert len({tuple(r) for r in zoomed}) == 1
    low, high = zoomed[0]
    length = whole[0][1] - whole[0][0]
    assert high - low == pytest.approx(length / 4, rel=0.05)
    assert low == pytest.approx(whole[0][0] + length / 4, abs=0.03 * length)
    ActionChains(browser).double_click(over).perform()
    assert ranges(browser) == whole


def test_buttons_show_a_shift_and_everything(browser: Any, page: str) -> None:
    opened(browser, page)
    whole = ranges(browser)
    buttons = {b.text: b for b in browser.find_elements(By.CSS_SELECTOR, ".plots button")}
    assert set(buttons) == {"whole", "backward to neutral", "neutral to forward", "+", "−"}
    buttons["neutral to forward"].click()
    low, high = ranges(browser)[0]
    assert 0.5 < low < 0.65 < high < 1.1
    buttons["+"].click()
    assert ranges(browser)[0][1] - ranges(browser)[0][0] == pytest.approx((high - low) / 2)
    buttons["whole"].click()
    assert ranges(browser) == whole


def test_it_fits_a_phone(browser: Any, page: str) -> None:
    opened(browser, page)
    phone = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    browser.get(page)
    wide, room = browser.execute_script(
        "return [document.documentElement.scrollWidth, window.innerWidth]"
    )
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert room == 390 and wide <= room


def test_dark_and_light_differ_and_keep_their_contrast(browser: Any, page: str) -> None:
    seen = {}
    for scheme in ("light", "dark"):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        opened(browser, page)
        seen[scheme] = browser.execute_script(
            "const s = getComputedStyle(document.body); return [s.backgroundColor, s.color]"
        )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert seen["light"] == ["rgb(255, 255, 255)", "rgb(26, 26, 26)"]
    assert seen["dark"] == ["rgb(20, 23, 26)", "rgb(236, 239, 241)"]


def test_it_prints(browser: Any, page: str, tmp_path: Path) -> None:
    opened(browser, page)
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})
    paper = base64.b64decode(printed["data"])
    assert paper.startswith(b"%PDF") and len(paper) > 50_000
    assert 2 <= paper.count(b"/Type /Page\n") + paper.count(b"/Type /Page ") <= 12
