"""Hostile input for every command, in this process: random bytes, huge numbers, deep nesting, bombs, tricks.

`python -m tests.fuzz.hostile COUNT [SEED]` runs as many cases and prints what came of them. A case fails
when an exception leaves `main`, when it takes too long, when bad input is not refused in one line, or when
a file appears outside --out.
"""

from __future__ import annotations

import contextlib
import gc
import gzip
import io
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from can_dbc.errors import InputError

ROOT = Path(__file__).resolve().parent.parent.parent
LONGEST_S = 60.0
LONGEST_RUN_S = 0.02
FORGET_EVERY = 250

NUMBERS = (
    "0", "-1", "1e308", "-1e308", "1e999", "nan", "inf", "-inf", "1e-320", "9" * 400, "9" * 5000,
    "0x7fffffff", "9223372036854775808", "-9223372036854775809", "1e15", "3.4e38", "0.1", "1e-9",
    "true", '"7"',
)  # fmt: skip
TEXTS = (
    "../../x", "/tmp/x", "..", ".", "/", "~/x", "a/../../b", "x" * 5000, "", " ", "\\u0000", "\\n",
    "\\u202e\\u0007", "CON", "-rf", "--out", "${HOME}", "%s%n", "nominal", "\\\\..\\\\x", "é" * 300,
)  # fmt: skip

SCENARIO = """name = "s"
duration_s = 0.02
trace_period_s = 0.001
initial_gear = "neutral"
request = [{ at_s = 0.01, gear = "backward" }]
[plant]
mounted = true
charged = ["N"]
[controller]
period_s = 0.005
[bus]
extra_load = 0.2
send_buffer = 8
[clock]
controller_ppm = 10.0
[[fault]]
kind = "loss"
message = "PositionPulse"
probability = 0.5
[[fault]]
kind = "babbling"
load = 0.5
end_s = 0.01
[[sensor_fault]]
kind = "stuck"
start_s = 0.005
[[valve_fault]]
kind = "slow"
valve = "B"
[model]
"valve.D_fall" = 0.03
[expect]
final_gear = "neutral"
metrics = { frames = { min = 1 } }
timing = [{ to = "arrived", max_s = 1.0 }]
"""
STUDY = """name = "s"
scenario = "lab_n_b"
reads = ["impact_speed_m_s"]
[[sweep]]
path = "valve.D_fall"
values = [0.03, 0.04]
[[sweep]]
path = "valve.D_rise"
low = 0.005
high = 0.01
count = 3
[[load]]
name = "a"
set = { "plant.mounted" = true }
[[variant]]
name = "b"
set = { "controller.filter" = false }
"""
CAMPAIGN = """name = "c"
rig = "both"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 1000.0
[[stroke]]
file = "stroke_001.csv"
label = "l"
kind = "fixed"
supply_pressure_pa = 900000.0
load = "none"
spring_n_per_m = 0.0
start_offset_m = 0.0
rest_s = 60.0
commands = [[0.01, "1", 0.98], [0.05, "1", 0.0]]
charged_before = []
"""
MODEL = """[base]
model = "nominal"
[valve]
D_fall = { value = 0.03, unit = "s", source = "x" }
"""


class Hung(BaseException):
    """A case took longer than LONGEST_S of processor time."""


class Bench:
    """A folder with what the cases start from, and the commands made harmless where they take long."""

    def __init__(self, folder: Path) -> None:
        from sil import cli

        self.folder = folder
        self.main = cli.main
        self.seeds = folder / "seeds"
        self.seeds.mkdir()
        self.logs = self._logs()
        self.dbc = (ROOT / "can_dbc" / "opc4.dbc").read_bytes()
        columns = "time_s,position_m,pressure_1_pa,pressure_2_pa,cmd_1"
        rows = [f"{k / 1000},{0.001 * k},{1e5 + k},101325.0,{int(k > 10)}" for k in range(60)]
        self.record = "\n".join([columns, *rows, ""]).encode()

    def _logs(self) -> dict[str, bytes]:
        found = {}
        run = self.seeds / "run"
        with quiet():
            (self.seeds / "s.toml").write_text(SCENARIO.replace("0.02", "0.2"))
            words = ["run", str(self.seeds / "s.toml"), "--no-report", "--out", str(run)]
            assert self.main(words) in (0, 1)
            for suffix in ("log", "asc", "trc", "csv", "blf", "mf4", "log.gz", "blf.gz"):
                assert (
                    self.main(["convert", str(run / "bus.log"), str(self.seeds / f"l.{suffix}")])
                    == 0
                )
                found[suffix] = (self.seeds / f"l.{suffix}").read_bytes()
        shutil.rmtree(self.seeds)
        return found

    def case(self, rng: random.Random) -> tuple[str, list[str]]:
        """Write the input of one case into the working folder; its kind and its arguments."""
        return rng.choice((self._scenario, self._study, self._dbc, self._log, self._log, self._campaign,
                           self._model, self._words))(rng)  # fmt: skip

    def _scenario(self, rng: random.Random) -> tuple[str, list[str]]:
        Path("s.toml").write_bytes(spoilt_toml(rng, SCENARIO))
        words = ["run", "s.toml", "--no-report", "--out", "out"]
        if rng.random() < 0.3:
            words += ["--set", f"{rng.choice(PATHS)}={rng.choice((*NUMBERS, *TEXTS))}"]
        return "scenario", words

    def _study(self, rng: random.Random) -> tuple[str, list[str]]:
        Path("s.toml").write_bytes(spoilt_toml(rng, STUDY))
        return "study", ["whatif", "s.toml", "--out", "out"]

    def _dbc(self, rng: random.Random) -> tuple[str, list[str]]:
        Path("x.dbc").write_bytes(spoilt_bytes(rng, self.dbc))
        return "dbc", ["bus", "--dbc", "x.dbc"]

    def _log(self, rng: random.Random) -> tuple[str, list[str]]:
        suffix = rng.choice(list(self.logs))
        raw = self.logs[suffix]
        roll = rng.random()
        if roll < 0.02 and suffix.endswith("gz"):
            raw = bomb(rng)
        elif roll < 0.4 and suffix.endswith("gz"):
            raw = gzip.compress(spoilt_bytes(rng, gzip.decompress(raw)), 1)
        else:
            raw = spoilt_bytes(rng, raw)
        Path(f"x.{suffix}").write_bytes(raw)
        words = rng.choice((["convert", f"x.{suffix}", "y." + rng.choice(("log", "asc", "csv", "blf"))],
                           ["replay", f"x.{suffix}", "--summary"],
                           ["replay", f"x.{suffix}", "--out", "out"]))  # fmt: skip
        return "log", words

    def _campaign(self, rng: random.Random) -> tuple[str, list[str]]:
        Path("c").mkdir()
        table, record = CAMPAIGN.encode(), self.record
        if rng.random() < 0.6:
            table = spoilt_toml(rng, CAMPAIGN)
        else:
            record = spoilt_bytes(rng, record)
        Path("c/campaign.toml").write_bytes(table)
        Path("c/stroke_001.csv").write_bytes(record)
        command = rng.choice((["simulate", "c"], ["diagnose", "c"], ["identify", "flow", "c"]))
        return "campaign", [*command, "--out", "out"]

    def _model(self, rng: random.Random) -> tuple[str, list[str]]:
        Path("m.toml").write_bytes(spoilt_toml(rng, MODEL))
        Path("s.toml").write_text(SCENARIO)
        return "model", ["run", "s.toml", "--model", "m.toml", "--no-report", "--out", "out"]

    def _words(self, rng: random.Random) -> tuple[str, list[str]]:
        command = rng.choice(("run", "replay", "whatif", "diagnose", "simulate", "convert", "bus",
                              "identify", "fmu", "node", "-", "--help"))  # fmt: skip
        pool = (*OPTIONS, *TEXTS, *NUMBERS, "out", "lab_n_b", "s.toml", "x\0y", "\udcff", "/dev/null",
                "/proc/self/mem", "out/../../z", "link")  # fmt: skip
        Path("link").symlink_to(self.folder / "outside")
        words = [rng.choice(pool) for _ in range(rng.randrange(5))]
        return "words", [command, *words]


OPTIONS = ("--out", "--force", "--json", "--set", "--seed", "--model", "--transport", "--speed", "--realtime",
           "--resume", "--workers", "--junit", "--dbc", "--summary", "--options", "--times", "--strict",
           "--channel", "--scenario", "--bitrate", "--list", "--firmware", "--external", "--cluster")  # fmt: skip
PATHS = ("duration_s", "controller.period_s", "valve.D_fall", "bus.bitrate", "fault", "request", "seed",
         "sensor.period_s", "controller.filter.cutoff_hz", "model_set", "firmware", "trace_period_s",
         "controller.strategy_parameters.x", "name", "clock.driver_ppm", "bus.extra_load")  # fmt: skip


def spoilt_toml(rng: random.Random, text: str) -> bytes:
    """A table with something wrong in it, or not a table at all."""
    roll = rng.random()
    if roll < 0.15:
        return spoilt_bytes(rng, text.encode())
    if roll < 0.2:
        depth = rng.choice((50, 500, 20_000))
        return (text + "\nz = " + "[" * depth + "]" * depth + "\n").encode()
    if roll < 0.25:
        key = ".".join(["a"] * rng.choice((10, 1000, 20_000)))
        return (f"{key} = 1\n" + text).encode()
    if roll < 0.27:
        return (text + "x" + str(rng.random()) + " = 1\n" * rng.choice((1, 100_000))).encode()
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        k = rng.randrange(len(lines))
        key, equals, _ = lines[k].partition(" = ")
        action = rng.randrange(5)
        if action == 0:
            lines.insert(k, lines[rng.randrange(len(lines))])
        elif action == 1:
            del lines[k]
            lines = lines or [""]
        elif equals and action == 2:
            lines[k] = f"{key} = {rng.choice(NUMBERS)}"
        elif equals and action == 3:
            lines[k] = f'{key} = "{rng.choice(TEXTS)}"'
        elif equals:
            lines[k] = (
                f"{key} = {rng.choice(('[]', '{}', '[[]]', '[1, [2]]', '{ a = 1 }', '2020-01-01'))}"
            )
    return "\n".join(lines).encode()


def spoilt_bytes(rng: random.Random, raw: bytes) -> bytes:
    """Bytes with some changed, cut, repeated, or others altogether."""
    roll = rng.random()
    if roll < 0.05:
        return rng.randbytes(rng.choice((0, 1, 100, 5000)))
    data = bytearray(raw)
    for _ in range(rng.choice((1, 1, 2, 8, 40))):
        if not data:
            break
        at = rng.randrange(len(data))
        action = rng.randrange(6)
        if action == 0:
            data[at] = rng.randrange(256)
        elif action == 1:
            del data[at : at + rng.choice((1, 4, 100))]
        elif action == 2:
            data[at:at] = rng.choice((*NUMBERS, *TEXTS, "\0", "\n", ",", "e99")).encode()
        elif action == 3:
            data[at:at] = data[at : at + rng.randrange(200)]
        elif action == 4:
            data[at : at + 8] = rng.choice((2**64 - 1, 2**63, 2**31, 0)).to_bytes(8, "little")
        else:
            del data[rng.randrange(at, len(data)) :]
    return bytes(data)


def bomb(rng: random.Random) -> bytes:
    """Little that unpacks to much: one line without an end, or very many."""
    piece = rng.choice((b"\0", b"(0.1) can0 1#00 ", b"\n", b"(0000000000.000100) can0 123#\n"))
    return gzip.compress(piece * ((20 << 20) // len(piece)), 9)


@contextlib.contextmanager
def quiet() -> Iterator[io.StringIO]:
    """What is printed, instead of printing it."""
    output = io.StringIO()
    with contextlib.redirect_stderr(output), contextlib.redirect_stdout(io.StringIO()):
        yield output


@contextlib.contextmanager
def harmless() -> Iterator[None]:
    """What would take long with good input ends at once, after all of the input has been read."""
    from sil.simulation import runner

    run = runner.run

    def short(loaded: Any, folder: Path, **how: Any) -> Any:
        scenario = loaded.scenario
        if (
            scenario.duration_s > LONGEST_RUN_S
            or how.get("transport", "inproc") != "inproc"
            or how["speed"]
        ):
            raise InputError("taken, and not run here")
        return run(loaded, folder, **how)

    def refuse(*arguments: Any, **named: Any) -> Any:
        raise InputError("taken, and not run here")

    def read_only(campaign: Any, *arguments: Any, **named: Any) -> Any:
        from sil.campaign.campaign import read_record

        for entry in campaign.strokes:
            read_record(campaign.folder / entry.file, campaign.recorder)
        raise InputError("taken, and not run here")

    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch("sil.simulation.runner.run", short))
        stack.enter_context(mock.patch("sil.studies.study.Study.run", refuse))
        stack.enter_context(mock.patch("sil.inference.campaign.diagnosis.diagnose", read_only))
        stack.enter_context(mock.patch("sil.coupling.transports.link.open_link", refuse))
        stack.enter_context(mock.patch("sil.fmu.export.export", refuse))
        yield


def ended(main: Callable[[list[str]], int], words: list[str]) -> tuple[str, str]:
    """How one call of the command ended, and what is wrong with that ("" for nothing)."""

    def hang(*_: Any) -> None:
        raise Hung

    signal.signal(signal.SIGPROF, hang)
    with quiet() as output:
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
        try:
            code = main(words)
        except Hung:
            return "hung", f"longer than {LONGEST_S} s"
        except BaseException:
            return "raised", traceback.format_exc()
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    text = output.getvalue()
    if code not in (0, 1, 2, 3):
        return "code", f"exit code {code}"
    if "Traceback" in text:
        return "traceback", text
    if code == 2 and len(text.splitlines()) != 1:
        return "lines", text
    if len(text) > 2000:
        return "long", text[:300]
    return f"exit {code}", ""


def campaign_of_cases(
    count: int, seed: int, report: Callable[[str], None]
) -> tuple[Counter[str], int]:
    """Run cases; how they ended by kind, and how many failed."""
    ends: Counter[str] = Counter()
    failures = 0
    home = os.getcwd()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "outside").mkdir()
        os.chdir(folder)
        try:
            bench = Bench(folder)
            stack.enter_context(harmless())
            for number in range(count):
                rng = random.Random(f"{seed}:{number}")
                shutil.rmtree("work", ignore_errors=True)
                Path("work").mkdir()
                os.chdir("work")
                kind, words = bench.case(rng)
                before = set(os.listdir("."))
                how, wrong = ended(bench.main, words)
                made = set(os.listdir(".")) - before - {"out", "runs"}
                made = {m for m in made if m not in words}
                os.chdir(folder)
                outside = sorted(set(os.listdir(".")) - {"outside", "work"}) + os.listdir("outside")
                if not wrong and (made or outside):
                    how, wrong = "outside", f"{sorted(made)} {outside}"
                    for one in outside:
                        shutil.rmtree(one, ignore_errors=True)
                ends[f"{kind}: {how}"] += 1
                if wrong:
                    failures += 1
                    report(f"case {seed}:{number}: {words!r}: {how}: {wrong}")
                if number % FORGET_EVERY == 0:
                    gc.unfreeze()  # a command's process freezes what it has loaded
                    gc.collect()
        finally:
            os.chdir(home)
    return ends, failures


def main() -> int:
    """The command line."""
    count, seed = int(sys.argv[1]), int((sys.argv[2:] or ["1"])[0])
    begun = time.process_time()
    ends, failures = campaign_of_cases(
        count, seed, lambda text: print(text, file=sys.stderr, flush=True)
    )
    for name, number in sorted(ends.items()):
        print(f"{name:24}{number:8}")
    print(
        f"{count} cases, {failures} failed, {time.process_time() - begun:.0f} s of processor time"
    )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
