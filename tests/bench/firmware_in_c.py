"""Firmware in C: speed of the closed loop, saved states, equality over drawn shifts, branches reached."""

from __future__ import annotations

import collections
import random
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from controller.c_settings import content
from controller.node import ControllerNode
from sil.firmware.c_firmware import CController
from sil.firmware.compiler import compiled
from sil.firmware.contract import header, pack_step
from sil.firmware.load import SHIPPED_IN_C
from sil.simulation.load_scenario import load
from sil.simulation.loop import Loop
from tests.support.twins import drawn_config, feed, run_with_twins
from tests.unit.sil.firmware.test_c_firmware import varied

DRAWN = 10_000
COVERED = 400
REPEATS = 40

DRIVER = """
#include "opc4.c"
#include <stdio.h>
int main(int count, char **names)
{
    FILE *file = fopen(names[count - 1], "rb");
    if (fread(&fw_in.settings, sizeof fw_in.settings, 1, file) != 1)
        return 1;
    fw_init();
    while (fread(&fw_in.now_ns, 16, 1, file) == 1) {
        if (fread(fw_in.frames, sizeof fw_in.frames[0], fw_in.count, file) != fw_in.count)
            return 1;
        memset(&fw_out, 0, sizeof fw_out);
        fw_step();
    }
    return 0;
}
"""


def timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """The function, its processor time added to `spent`."""

    def call(*arguments: Any) -> Any:
        begin = time.process_time()
        try:
            return function(*arguments)
        finally:
            spent[name] += time.process_time() - begin

    return call


def speed(firmware: str) -> str:
    """Shifts per second and core with a firmware, and who takes the time."""
    spent: dict[str, float] = collections.defaultdict(float)
    loaded = load("full_shift", settings={"firmware": firmware} if firmware else {})
    Loop(loaded).finish()
    whole = shifts = 0.0
    for _ in range(REPEATS):
        loop = Loop(loaded)
        for participant in loop.participants:
            name = (
                participant.name if participant.name in ("controller", "plant") else "bus and rest"
            )
            participant.advance = timed(participant.advance, name, spent)  # type: ignore[method-assign]
        begin = time.process_time()
        loop.finish()
        whole += time.process_time() - begin
        shifts += 2
    parts = {name: spent[name] / whole for name in ("controller", "plant")}
    rest = 1.0 - sum(parts.values())
    return (
        f"{shifts / whole:6.1f} shifts/s and core; firmware {parts['controller']:.0%}, "
        f"plant {parts['plant']:.0%}, bus and rest {rest:.0%}"
    )


def saved(firmware: str) -> str:
    """Time of snapshot and restore of a loop in the middle of a shift."""
    loop = Loop(load("full_shift", settings={"firmware": firmware} if firmware else {}))
    loop.advance(0.2)
    loop.snapshot()  # the first one looks for all that may change
    begin = time.process_time()
    for _ in range(REPEATS):
        state = loop.snapshot()
    between = time.process_time()
    for _ in range(REPEATS):
        loop.restore(state)
    end = time.process_time()
    times = (between - begin, end - between)
    snapshot_us, restore_us = (1e6 * each / REPEATS for each in times)
    return f"snapshot {snapshot_us:6.0f} us, restore {restore_us:6.0f} us"


def branches() -> Iterator[str]:
    """Branches of the C sources that drawn inputs reach, by gcc and gcov."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(SHIPPED_IN_C.parent, folder, dirs_exist_ok=True)
        (folder / "opc4.h").write_text(header())
        (folder / "driver.c").write_text(DRIVER)
        subprocess.run(
            ["gcc", "--coverage", "-O0", "-o", "driver", "driver.c", "-lm"], cwd=folder, check=True
        )
        for number in range(COVERED):
            rng = random.Random(f"inputs {number}")
            config = drawn_config(rng)
            unit = CController(SHIPPED_IN_C, config)
            unit.steps = []
            feed(ControllerNode(config), unit, rng)
            content_of_run = [content(config), *map(pack_step, unit.steps)]
            (folder / "steps").write_bytes(b"".join(content_of_run))
            subprocess.run([folder / "driver", folder / "steps"], check=True)
        told = subprocess.run(
            ["gcov", "-b", "driver.gcda"], cwd=folder, capture_output=True, text=True, check=True
        ).stdout
        for file, taken in re.findall(
            r"File '(\w+\.[hc])'\n.*\n.*\nTaken at least once:(.*)\n", told
        ):
            if file != "driver.c":
                yield f"{file}: branches taken {taken}"
        for source in sorted(folder.glob("*.gcov")):
            if source.stem in ("shift.h",):
                yield from missed(source)


UNREACHED = {
    "if (!is_in(transitions[event].from))": "a transition that the table does not have: a defect",
    "if (seen->recoverable ": "an internal fault is latched only if a strategy breaks the interlock; none does",
    "switch (machine.state) {": "a state that the enumeration does not have",
}
"""Branches of the state machine that no input reaches, and why they are there."""


def missed(source: Path) -> Iterator[str]:
    """Lines of a source with a branch that was never taken, and the reason if there is one."""
    line = ""
    for text in source.read_text().splitlines():
        if text.startswith("branch"):
            if "never executed" in text or "taken 0%" in text:
                number, code = line.split(":", 2)[1:]
                known = (why for begin, why in UNREACHED.items() if code.strip().startswith(begin))
                yield f"  {number.strip()}: {code.strip()}: {next(known, 'NO REASON')}"
        elif ":" in text:
            line = text


def measure() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "opc4.wasm"
        plain.write_bytes(compiled(SHIPPED_IN_C))
        firmwares = {"Python": "", "wasm plain": str(plain), "wasm plain and sanitised": "c"}
        for figures in (speed, saved):
            for title, firmware in firmwares.items():
                yield f"{title:26} {figures(firmware)}"
    yield from branches()
    begin = time.perf_counter()
    for number in range(DRAWN):
        run_with_twins(varied(number), str(SHIPPED_IN_C))
    yield f"{DRAWN} drawn shifts with faults: the same frames, {time.perf_counter() - begin:.0f} s"
