"""A browser, and a page of each kind as its command writes it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver

from plant.parameters import Parameter, ParameterSet, load
from sil.cli import main
from tests.support.force_rig import rig
from tests.support.made_campaign import made
from tests.support.truck_synthesis import DRIVE, Truck, write_log

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-quic", "--hide-scrollbars",
)  # fmt: skip


STUDY = """
name = "closing"
scenario = "lab_n_b"
[[sweep]]
path = "valve.D_fall"
low = 0.005
high = 0.04
steps = 4
scale = "log"
[[load]]
name = "9 bar"
[[load]]
name = "6 bar"
set = { "plant.supply_pressure_pa" = 600000.0 }
"""


CHOICES = """
name = "choices"
reads = ["arrival_s", "impact_speed_m_s"]
[stroke]
kind = "N-B"
commands = [[0.01, "B", 0.98], [0.01, "N", 0.0]]
[[variant]]
name = "neutral vented before"
set = { "stroke.charged_before" = "" }
[[variant]]
name = "neutral charged before"
set = { "stroke.charged_before" = "N" }
[[load]]
name = "9 bar"
[[load]]
name = "7 bar"
set = { "stroke.supply_pressure_pa" = 700000.0 }
[[load]]
name = "6 bar"
set = { "stroke.supply_pressure_pa" = 600000.0 }
"""


@contextlib.contextmanager
def started(profile: Path) -> Iterator[Any]:
    """Chromium without a screen, with a profile of its own."""
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(
        options=options, service=webdriver.ChromeService("/usr/bin/chromedriver")
    )
    try:
        yield driver
    finally:
        driver.quit()


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with started(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


def of_run(folder: Path) -> list[str]:
    return ["run", "full_shift"]


def of_compare(folder: Path) -> list[str]:
    for name, pressure in (("nine", "9bar"), ("seven", "7bar")):
        words = ["--set", f"plant.supply_pressure_pa={pressure}", "--no-report"]
        assert main(["run", "full_shift", *words, "--out", str(folder / name)]) == 0
    return ["compare", str(folder / "nine"), str(folder / "seven")]


def of_replay(folder: Path) -> list[str]:
    assert main(["run", "full_shift", "--no-report", "--out", str(folder / "run")]) == 0
    log = str(folder / "run" / "bus.log")
    return ["replay", log, "--set", "controller.filter=false", "--plant"]


def of_truck(folder: Path) -> list[str]:
    frames = Truck(drive=DRIVE[:1], end_ms=6_000).frames()
    return ["replay", str(write_log(folder / "truck.log", frames)), "--strategy", "air_cushion"]


def of_whatif(folder: Path) -> list[str]:
    study = folder / "study.toml"
    study.write_text(STUDY, encoding="utf-8")
    return ["whatif", str(study)]


def of_choices(folder: Path) -> list[str]:
    study = folder / "study.toml"
    study.write_text(CHOICES, encoding="utf-8")
    return ["whatif", str(study)]


def of_strokes(folder: Path) -> list[str]:
    return ["whatif", "piston_mass"]


def of_diagnose(folder: Path) -> list[str]:
    base = load()
    hidden = {"exhaust_clog": {"factor": Parameter(0.75, "-", "hidden by the test")}}
    made(folder / "measured", ParameterSet(base.name, base.entries, hidden), seed=11, count=6)
    return ["diagnose", str(folder / "measured"), "--workers", "2"]


def of_force(folder: Path) -> list[str]:
    return ["diagnose", str(rig(folder / "rig", stribeck_n=25.0))]


MAKERS: dict[str, tuple[Callable[[Path], list[str]], int]] = {
    "run": (of_run, 0),
    "compare": (of_compare, 0),
    "replay": (of_replay, 1),
    "truck": (of_truck, 0),
    "whatif": (of_whatif, 0),
    "choices": (of_choices, 0),
    "strokes": (of_strokes, 0),
    "diagnose": (of_diagnose, 1),
    "force": (of_force, 1),
}
"""The arguments of the command that writes a page of the kind, and its exit code."""


@pytest.fixture(scope="session")
def page_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """The address of the page of a kind, made once."""
    known: dict[str, str] = {}

    def made_once(kind: str) -> str:
        if kind not in known:
            folder = tmp_path_factory.mktemp(kind)
            arguments, code = MAKERS[kind][0](folder), MAKERS[kind][1]
            assert main([*arguments, "--out", str(folder / "out")]) == code
            known[kind] = (folder / "out" / "report.html").as_uri()
        return known[kind]

    return made_once


@pytest.fixture(params=list(MAKERS))
def page(request: pytest.FixtureRequest, page_of: Callable[[str], str]) -> str:
    """A page of each kind in turn."""
    return page_of(request.param)
