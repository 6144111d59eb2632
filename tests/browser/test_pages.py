"""Every page in a real browser: it opens without a complaint, draws, zooms together, fits a phone."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

pytestmark = pytest.mark.browser

PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
LEAST_INK = 400
INK = """return window.opc4Plots().flat().map(c => {
  const d = c.ctx.getImageData(c.bbox.left, c.bbox.top, c.bbox.width, c.bbox.height).data;
  let n = 0;
  for (let i = 0; i < d.length; i += 4)
    n += d[i + 3] > 0 && Math.max(d[i], d[i + 1], d[i + 2]) - Math.min(d[i], d[i + 1], d[i + 2]) > 40
         || d[i + 3] > 0 && Math.max(d[i], d[i + 1], d[i + 2]) < 150;
  return n; })"""
"""Pixels inside the axes that are neither paper nor the pale grey of grid and bands."""


UNMARKED = """return [...document.querySelectorAll("main *")].filter(e =>
  ["auto", "scroll"].includes(getComputedStyle(e).overflowX) && e.tagName !== "PRE"
  && e.scrollWidth > e.clientWidth + 1
  && !getComputedStyle(e, "::before").content.includes("swipe")).map(e => e.outerHTML.slice(0, 80))"""
"""Boxes that are wider than the screen without saying so."""


def ranges(browser: Any) -> list[list[list[float]]]:
    """Lower and upper end of the common axis (logarithmic: their logarithms), by group and panel."""
    found: list[list[list[float]]] = browser.execute_script(
        "return window.opc4Plots().map(g => g.map(c => [c.scales.x.min, c.scales.x.max]"
        ".map(v => c.scales.x.distr === 3 ? Math.log(v) : v)))"
    )
    return found


def opened(browser: Any, page: str, width: int = 1200, height: int = 900) -> None:
    browser.set_window_size(width, height)
    browser.get(page)


def pages_of(paper: bytes) -> int:
    return len(re.findall(rb"/Type /Page[\s/]", paper))


def test_it_opens_without_a_complaint_and_asks_the_network_for_nothing(
    browser: Any, page: str
) -> None:
    # the page of the live bench before goes on asking its server, which has ended
    browser.get("about:blank")
    browser.get_log("browser")
    opened(browser, page)
    assert browser.get_log("browser") == []
    assert browser.title and browser.find_element(By.TAG_NAME, "h1").text
    script = "return performance.getEntriesByType('resource').map(e => e.name)"
    asked = browser.execute_script(script)
    assert [name for name in asked if not name.startswith("data:")] == []


def test_every_panel_and_picture_is_drawn(browser: Any, page: str) -> None:
    opened(browser, page)
    inked = browser.execute_script(INK)
    assert len(inked) >= 1 and min(inked) > LEAST_INK, inked
    script = "return [...document.images].map(i => [i.complete, i.naturalWidth])"
    sizes = browser.execute_script(script)
    assert len(sizes) >= 1 and all(whole and wide > 300 for whole, wide in sizes)


def test_a_drag_zooms_the_panels_of_its_group_and_a_double_click_shows_everything(
    browser: Any, page: str
) -> None:
    opened(browser, page)
    whole = ranges(browser)
    assert all(len({tuple(r) for r in group}) == 1 for group in whole)
    over = browser.find_elements(By.CSS_SELECTOR, ".plots:first-of-type .u-over")[0]
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", over)
    wide = over.size["width"]
    start = ActionChains(browser).move_to_element_with_offset(over, -wide // 4, 0)
    start.click_and_hold().move_by_offset(wide // 4, 0).release().perform()
    zoomed = ranges(browser)
    assert len({tuple(r) for r in zoomed[0]}) == 1
    assert zoomed[1:] == whole[1:]
    (low, high), (first, last) = zoomed[0][0], whole[0][0]
    assert high - low == pytest.approx((last - first) / 4, rel=0.05)
    assert low == pytest.approx(first + (last - first) / 4, abs=0.03 * (last - first))
    ActionChains(browser).double_click(over).perform()
    assert ranges(browser) == whole


def test_buttons_zoom_and_move(browser: Any, page: str) -> None:
    opened(browser, page)
    first, last = ranges(browser)[0][0]
    bar = browser.find_element(By.CSS_SELECTOR, ".plots .bar")
    buttons = {b.text: b for b in bar.find_elements(By.TAG_NAME, "button")}
    assert {"whole", "+", "−", "←", "→"} <= set(buttons)
    buttons["+"].click()
    low, high = ranges(browser)[0][0]
    assert high - low == pytest.approx((last - first) / 2)
    buttons["→"].click()
    assert ranges(browser)[0][0] == pytest.approx([low + (last - first) / 4, last])
    buttons["→"].click()
    assert ranges(browser)[0][0][1] == pytest.approx(last)
    buttons["−"].click()
    buttons["whole"].click()
    assert ranges(browser)[0][0] == [first, last]


def test_it_fits_a_phone_and_fingers_zoom(browser: Any, page: str) -> None:
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    browser.execute_cdp_cmd(
        "Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2}
    )
    try:
        browser.get(page)
        wide, room = browser.execute_script(
            "return [document.documentElement.scrollWidth, innerWidth]"
        )
        assert room == 390 and wide <= room
        assert min(browser.execute_script(INK)) > LEAST_INK / 4
        assert browser.execute_script(UNMARKED) == []
        over = browser.find_element(By.CSS_SELECTOR, ".u-over")
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", over)
        whole = ranges(browser)[0][0]
        box = browser.execute_script("return arguments[0].getBoundingClientRect().toJSON()", over)
        middle, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

        def touch(kind: str, *apart: float) -> None:
            points = [
                {"x": middle + s * d, "y": y, "id": k} for d in apart for k, s in enumerate((-1, 1))
            ]
            browser.execute_cdp_cmd(
                "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points}
            )

        touch("touchStart", 30.0)
        touch("touchMove", 60.0)
        touch("touchEnd")
        low, high = ranges(browser)[0][0]
        assert high - low == pytest.approx((whole[1] - whole[0]) / 2, rel=0.05)
    finally:
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


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


def test_it_prints_in_light_colours_within_the_paper(browser: Any, page: str) -> None:
    feature = {"name": "prefers-color-scheme", "value": "dark"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    opened(browser, page)
    browser.execute_script(
        "window.addEventListener('beforeprint', () => { window.printed ="
        " window.opc4Plots().flat().map(c => c.width); })"
    )
    printed = browser.execute_cdp_cmd(
        "Page.printToPDF", {"printBackground": True, "paperWidth": 8.27, "paperHeight": 11.69}
    )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    paper = base64.b64decode(printed["data"])
    assert paper.startswith(b"%PDF") and len(paper) > 40_000
    assert 1 <= pages_of(paper) <= 25
    assert set(browser.execute_script("return window.printed")) == {680}
    widths = browser.execute_script("return window.opc4Plots().flat().map(c => c.width)")
    assert set(widths) != {680}


def test_the_buttons_of_a_run_show_its_shifts(browser: Any, page_of: Callable[[str], str]) -> None:
    opened(browser, page_of("run"))
    (whole,) = ranges(browser)
    assert len(whole) == 7
    buttons = {b.text: b for b in browser.find_elements(By.CSS_SELECTOR, ".plots button")}
    assert {"backward to neutral", "neutral to forward"} < set(buttons)
    buttons["neutral to forward"].click()
    low, high = ranges(browser)[0][0]
    assert 500.0 < low < 650.0 < high < 1100.0
    assert ranges(browser) == [[[low, high]] * 7]


@pytest.mark.parametrize("kind", ["diagnose"])
def test_each_stroke_has_a_group_of_its_own(
    browser: Any, page_of: Callable[[str], str], kind: str
) -> None:
    opened(browser, page_of(kind))
    groups = ranges(browser)
    assert len(groups) >= 2 and all(len(group) >= 4 for group in groups)


def test_figures_lie_beside_the_page_as_png_and_svg(page: str) -> None:
    folder = Path(page.removeprefix("file://")).parent
    drawings = {path.stem for path in folder.glob("*.png")}
    assert drawings and drawings == {path.stem for path in folder.glob("*.svg")}


def test_choices_stand_by_name_on_their_axis(browser: Any, page_of: Callable[[str], str]) -> None:
    opened(browser, page_of("choices"))
    over = browser.find_elements(By.CSS_SELECTOR, ".plots:first-of-type .u-over")[-1]
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", over)
    for share, name in ((-0.33, "9 bar"), (0.0, "7 bar"), (0.33, "6 bar")):
        place = int(share * over.size["width"])
        ActionChains(browser).move_to_element_with_offset(over, place, 0).perform()
        legend = browser.find_elements(By.CSS_SELECTOR, ".plots:first-of-type .u-legend")[-1]
        assert legend.find_element(By.CSS_SELECTOR, ".u-value").text == name
    shown = "return window.opc4Plots().at(0).map(c => c.axes[0]._values)"
    assert browser.execute_script(shown) == [["", "", ""], ["9 bar", "7 bar", "6 bar"]]
