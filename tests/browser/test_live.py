"""The live bench driven as a person would: tabs, gears, sliders, faults, reload, two tabs, a restart."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select
from selenium.webdriver.support.ui import WebDriverWait

from sil.api import run
from sil.cli import main
from sil.files.overrides import parse_setting
from tests.browser.test_pages import INK, LEAST_INK, PHONE, UNMARKED
from tests.conftest import ROOT

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("runs")
    assert main(["run", "lab_n_b", "--out", str(made / "first")]) == 0
    return made


@pytest.fixture(scope="module")
def live(folder: Path) -> Iterator[Live]:
    served = Live(folder)
    yield served
    assert served.end() == 0


def test_a_shift_by_hand_repeats_to_the_bit(browser: Any, live: Live, tmp_path: Path) -> None:
    behaviour = {"behavior": "allow", "downloadPath": str(tmp_path)}
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", behaviour)
    page = Page(browser, live.address)
    assert "token" not in browser.current_url and page.drawn()
    page.at(180.0)
    true_mm, estimate_mm = (
        float(page.read()[name][0]) for name in ("true position", "controller's estimate")
    )
    assert true_mm < 12.0 and estimate_mm > true_mm + 0.5  # it learns of it later
    page.click("step")
    assert page.text("clock") == "190.0 ms"  # the cursor, the step and the clock are one
    page.after(lambda: page.click("by-hand"))
    page.at(200.0)
    page.after(lambda: page.browser.find_element(By.CSS_SELECTOR, "[data-gear=forward]").click())
    page.at(850.0)
    assert -14.0 < float(page.read()["true position"][0]) < -10.0
    page.click("copy-scenario")
    file = tmp_path / "full_shift.toml"
    page.wait(file.is_file)
    assert file.read_text(encoding="utf-8") == page.scenario()
    assert main(["run", str(file), "--out", str(tmp_path / "out"), "--no-report"]) in (0, 1)
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["trace_sha256"] == page.text("trace")
    clock = page.text("clock")
    page.click("play")
    page.wait(lambda: page.text("clock") != clock)
    page.click("play")
    assert browser.get_log("browser") == []


def test_at_1440_by_900_nothing_scrolls_and_at_900_by_700_only_traces(
    browser: Any, live: Live
) -> None:
    for scenario, wide, high in (
        ("full_shift", 1440, 900), ("truck_torque_to_torque", 1440, 900), ("full_shift", 900, 700),
    ):  # fmt: skip
        browser.set_window_size(wide, high)
        page = Page(browser, f"{live.address}#{quote(json.dumps({'scenario': scenario}))}")
        page.after(lambda page=page: page.slide("valve.D_fall", 30))
        table = page.one("metrics").rect
        assert table["y"] > 0 and table["y"] + table["height"] <= page.inner()[1]
        assert browser.execute_script("return actuator.getBoundingClientRect().height") == 120.0
        for tab in ("shift", "bus", "runs"):
            page.click(f"tab-{tab}")
            page.wait(lambda page=page, tab=tab: tab == "runs" or page.drawn())
            allowed = [] if wide == 1440 else ["panels"]
            assert [box for box in browser.execute_script(SCROLLING) if box not in allowed] == []


@pytest.mark.parametrize(("wide", "high"), [(1440, 900), (900, 700)])
def test_names_beside_the_traces_are_whole_and_lie_on_no_other(
    browser: Any, live: Live, wide: int, high: int
) -> None:
    browser.set_window_size(wide, high)
    page = Page(browser, live.address)
    for act in (lambda: None, lambda: page.after(lambda: page.slide("valve.D_fall", 30))):
        act()
        boxes = browser.execute_script(LANES)
        assert len(boxes) >= 7
        for number, (top, bottom, low, deep) in enumerate(boxes):
            assert low - 1 <= top and bottom <= deep + 1
            assert all(bottom <= other[0] + 2 or other[1] <= top + 2 for other in boxes[:number])
    cut = browser.execute_script(
        "return [...document.querySelectorAll('#shift-plots .read span')]"
        ".filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.textContent)"
    )
    assert wide < 1440 or cut == []


LANES = """return [...document.querySelectorAll('#shift-plots .lane')].map(e => {
  const [own, panel] = [e, e.closest('.panel')].map(b => b.getBoundingClientRect());
  return [own.top, own.bottom, panel.top, panel.bottom]; })"""
"""Upper and lower edge of each name of a lane, and those of its panel."""

SCROLLING = """return [document.documentElement, ...document.querySelectorAll("body *")].filter(e =>
  (e === document.documentElement || ["auto", "scroll"].includes(getComputedStyle(e).overflowY))
  && (e.scrollHeight > e.clientHeight + 1 || e.scrollWidth > e.clientWidth + 1)).map(e => e.id || e.className || e.tagName)"""
"""What could be scrolled."""


def test_another_scenario_keeps_what_means_the_same(browser: Any, live: Live) -> None:
    settings = {"valve.D_fall": 0.02, "controller.strategy": "bang_bang", "bus.nonsense": 1}
    page = Page(browser, f"{live.address}#{quote(json.dumps({'settings': settings}))}")
    page.wait(lambda: "bus.nonsense" in page.text("note"))
    page.after(lambda: Select(page.one("scenario")).select_by_visible_text("lab_n_b"))
    state = json.loads(unquote(browser.current_url.split("#")[1]))
    assert state["settings"] == {"valve.D_fall": 0.02, "controller.strategy": "bang_bang"}
    page.click("tab-bus")
    page.wait(lambda: browser.find_elements(By.CSS_SELECTOR, "#fault select[name=message]"))
    first = Select(browser.find_element(By.CSS_SELECTOR, "#fault select[name=message]"))
    only = Select(page.one("only"))
    assert first.first_selected_option.text in {option.text for option in only.options}


def test_a_slider_a_reload_and_a_second_tab(browser: Any, live: Live) -> None:
    page = Page(browser, live.address)
    page.wait(page.drawn)
    page.after(lambda: page.slide("valve.D_fall", 30))
    slider = browser.find_element(By.CSS_SELECTOR, "[data-path='valve.D_rise']")
    page.after(lambda: ActionChains(browser).drag_and_drop_by_offset(slider, 20, 0).perform())
    assert "valve.D_rise" in page.scenario()
    page.after(lambda: ActionChains(browser).drag_and_drop_by_offset(slider, 35, 0).perform())
    page.after(lambda: page.click("reset"))
    first = page.after(lambda: page.slide("valve.D_fall", 31))
    command = page.one("copy-command").get_attribute("data-text")
    assert "--set valve.D_fall=0.0155" in command
    words = shlex.split(command)
    settings = dict(parse_setting(w) for w in words[3:] if w != "--set")
    assert run(words[2], settings).trace_sha256 == first
    cells = [c.text for c in browser.find_elements(By.CSS_SELECTOR, "#metrics td")]
    assert cells[:3:2] == ["backward to neutral", "97.14 ms"] and cells[6] == "request to stop, sum"
    field = browser.find_element(By.CSS_SELECTOR, "[data-field='valve.D_rise']")
    page.after(lambda: field.send_keys(Keys.CONTROL, "a", Keys.NULL, "7.25", Keys.ENTER))
    assert 'valve.D_rise" = 0.00725' in page.scenario()
    tip = field.find_element(By.XPATH, "..").get_attribute("title")
    assert tip.startswith("--set valve.D_rise=0.008") and "0 to 10000 ms" in tip
    first = page.after(lambda: field.send_keys(Keys.CONTROL, "a", Keys.NULL, "8", Keys.ENTER))
    browser.refresh()
    page.wait(lambda: page.text("trace") == first)
    address = browser.current_url
    browser.switch_to.new_window("tab")
    try:
        Page(browser, live.address)
        browser.get(address)
        browser.refresh()
        page.wait(lambda: page.text("trace") == first)
        page.after(lambda: page.click("filter"))
    finally:
        browser.close()
        browser.switch_to.window(browser.window_handles[0])
    assert page.text("trace") == first
    page.after(lambda: page.click("reset"))


def test_something_is_broken_and_mended(browser: Any, live: Live) -> None:
    page = Page(browser, live.address)
    page.at(150.0)
    page.click("tab-bus")
    page.wait(lambda: len(browser.find_elements(By.CSS_SELECTOR, "#frames tbody tr")) > 3)
    whole = page.text("trace")
    kinds = Select(browser.find_element(By.CSS_SELECTOR, "#fault select"))
    kinds.select_by_visible_text("bus: bus_off")
    Select(browser.find_element(By.NAME, "node")).select_by_visible_text("controller")
    broken = page.after(lambda: browser.find_element(By.CSS_SELECTOR, "#fault button").click())
    assert "bus_off from 0.15 s" in page.text("faults") and "[[fault]]" in page.scenario()
    assert run(tomllib.loads(page.scenario())).trace_sha256 == broken
    kinds = Select(browser.find_element(By.CSS_SELECTOR, "#fault select"))
    kinds.select_by_visible_text("bus: delay")
    delay = browser.find_element(By.NAME, "delay_s")
    delay.send_keys("-5")
    browser.find_element(By.CSS_SELECTOR, "#fault button").click()
    page.wait(lambda: "delay_s" in page.text("error"))
    assert page.text("trace") == broken  # refused with its line, nothing lost
    remove = browser.find_element(By.CSS_SELECTOR, "#faults button")
    assert page.after(lambda: remove.send_keys(Keys.ENTER)) == whole
    Select(page.one("only")).select_by_visible_text("ValveCommand")
    rows = browser.find_elements(By.CSS_SELECTOR, "#frames tbody tr")
    assert rows and all("ValveCommand" in row.get_attribute("textContent") for row in rows)


def test_frames_of_another_process_are_heard(browser: Any, live: Live, tmp_path: Path) -> None:
    page = Page(browser, live.address)
    page.click("tab-bus")
    name = f"live-{live.port}"
    other = subprocess.Popen(
        [sys.executable, "-m", "sil.cli", "run", "full_shift", "--transport", f"local:{name}",
         "--speed", "0.2", "--no-report", "--out", str(tmp_path / "other")],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        channel = page.one("channel")
        channel.clear()
        channel.send_keys(name)

        def heard() -> bool:
            if page.text("listen") == "Listen":
                page.click("listen")
            return bool(re.match(r"\d{2,} frames heard", page.text("heard")))

        page.wait(heard)
        assert browser.find_elements(By.CSS_SELECTOR, "#frames tbody tr")
    finally:
        other.wait(WAIT_S)


def test_runs_are_listed_opened_and_compared(browser: Any, live: Live, folder: Path) -> None:
    page = Page(browser, live.address)
    page.one("tab-shift").send_keys(Keys.ARROW_LEFT)  # round to the last tab, by keyboard
    page.wait(lambda: "first" in page.text("listed"))
    assert main(["run", "lab_n_b", "--out", str(folder / "second"), "--no-report",
                 "--set", "valve.D_rise=0.012"]) in (0, 1)  # fmt: skip
    page.wait(lambda: "second" in page.text("listed"))  # listed by itself
    for name in ("first", "second"):
        page.wait(lambda name=name: click_box(browser, name))
    page.wait(lambda: len(browser.execute_script(INK_OF_SHOWN)) == 2 and page.drawn())
    page.wait(lambda: open_link(browser))
    page.wait(lambda: "/runs/first/report.html" in browser.current_url)
    assert "lab_n_b" in browser.title


def click_box(browser: Any, name: str) -> bool:
    done: bool = browser.execute_script(
        "const b = document.querySelector(`[aria-label='compare ${arguments[0]}']`);"
        "if (!b || b.disabled) return false; if (!b.checked) b.click(); return true",
        name,
    )
    return done


def open_link(browser: Any) -> bool:
    done: bool = browser.execute_script(
        "const a = document.querySelector('#listed a'); if (!a) return false; a.click(); return true"
    )
    return done


def test_the_server_is_killed_and_started_again(browser: Any, folder: Path) -> None:
    served = Live(folder)
    page = Page(browser, served.address)
    page.wait(page.drawn)
    first = page.after(lambda: page.slide("valve.D_fall", 30))
    served.process.kill()
    served.process.wait(30.0)
    assert served.process.stdout is not None
    served.process.stdout.close()
    page.slide("valve.D_fall", 40)
    page.wait(lambda: "does not answer" in page.text("error"))
    again = Live(folder, served.port)
    try:
        page.wait(lambda: "Open the address that it printed" in page.text("error"))
        browser.switch_to.new_window("tab")
        browser.get(again.address)
        browser.close()
        browser.switch_to.window(browser.window_handles[0])
        page.wait(lambda: "was started again" in page.text("note"))  # and goes on by itself
        page.wait(lambda: 'D_fall" = 0.02' in page.scenario() and page.text("error") == "")
        assert page.text("trace") != first
    finally:
        assert again.end() == 0
    browser.get_log("browser")  # the failed requests are known


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_every_tab(browser: Any, live: Live, dark: bool) -> None:
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    try:
        page = Page(browser, live.address)
        for tab in ("shift", "bus", "runs"):
            page.click(f"tab-{tab}")
            page.wait(lambda: page.text("error") == "")
            wide = browser.execute_script("return document.documentElement.scrollWidth")
            assert wide <= PHONE["width"], tab
            if tab == "runs":
                page.wait(
                    lambda: "nothing yet" in page.text("listed") or "first" in page.text("listed")
                )
            if tab != "bus":
                page.wait(lambda: browser.execute_script(UNMARKED) == [])
        paper = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, re.findall(r"\d+", paper)[:3])) < 150) is dark
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


WAIT_S = 60.0


class Live:
    """`opc4 live` in a process of its own."""

    def __init__(self, folder: Path, port: int = 0) -> None:
        words = ["live", "--no-browser", "--port", str(port), "--runs", str(folder)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sil.cli", *words],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()
        self.port = int(re.findall(r":(\d+)/", self.address)[0])

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(30.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


INK_OF_SHOWN = INK.replace(
    "window.opc4Plots().flat()", "window.opc4Plots().flat().filter(c => c.root.offsetWidth)"
)


class Page:
    """What a person does and sees."""

    def __init__(self, browser: Any, address: str) -> None:
        self.browser = browser
        browser.get("about:blank")
        browser.get(address)
        self.wait(lambda: self.text("trace"))

    def wait(self, until: Callable[[], Any]) -> Any:
        return WebDriverWait(self.browser, WAIT_S).until(lambda _: until())

    def one(self, name: str) -> Any:
        return self.browser.find_element(By.ID, name)

    def text(self, name: str) -> str:
        found: str = self.one(name).get_attribute("textContent")
        return found

    def click(self, name: str) -> None:
        self.one(name).click()

    def after(self, act: Callable[[], Any]) -> str:
        """Act, and return the hash of the new run."""
        before = self.text("trace")
        act()
        self.wait(lambda: self.text("trace") != before)
        return self.text("trace")

    def slide(self, path: str, value: int) -> None:
        self.browser.execute_script(
            "const s = document.querySelector(`[data-path='${arguments[0]}']`);"
            "s.value = arguments[1]; s.dispatchEvent(new Event('input'))",
            path, value,
        )  # fmt: skip

    def at(self, time_ms: float) -> None:
        """Put the cursor there, as a press on the first plot does."""
        self.browser.execute_script(
            "const chart = window.opc4Plots().flat().find(c => c.root.offsetWidth);"
            "const clientX = chart.over.getBoundingClientRect().left + chart.valToPos(arguments[0], 'x');"
            "chart.over.setPointerCapture = () => {};"
            "chart.over.dispatchEvent(new PointerEvent('pointerdown', { clientX, pointerId: 1 }))",
            time_ms,
        )

    def read(self) -> dict[str, list[str]]:
        """The values beside the plots: now and before, by name."""
        rows = self.browser.execute_script(
            "return [...document.querySelectorAll('.read div:not(.name)')].filter(r => r.offsetWidth)"
            ".map(r => [...r.children].map(c => c.textContent))"
        )
        return {name: values for name, *values in rows}

    def inner(self) -> list[int]:
        """Width and height of the window's content."""
        size: list[int] = self.browser.execute_script("return [innerWidth, innerHeight]")
        return size

    def scenario(self) -> str:
        found: str = self.one("copy-scenario").get_attribute("data-text")
        return found

    def drawn(self) -> bool:
        inks = self.browser.execute_script(INK_OF_SHOWN)
        return bool(inks) and max(inks) >= LEAST_INK
