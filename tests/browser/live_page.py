"""`opc4 live` in a process of its own, and its page as a person uses it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from tests.browser.test_pages import INK, LEAST_INK
from tests.conftest import ROOT

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
