"""Whatever kills, interrupts, starves or write-protects a command: nothing lost, one line, the right exit code."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from plant.kernel.compiled import cache_folder
from sil import cli
from sil.files.output_folder import INCOMPLETE, LAST_WRITTEN
from tests.conftest import ROOT

STUDY = """name = "few"
scenario = "lab_n_b"
reads = ["impact_speed_m_s"]
[[sweep]]
path = "valve.D_fall"
values = [0.03, 0.035, 0.04]
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run, a simulated campaign and a study: what the commands read."""
    folder = tmp_path_factory.mktemp("made")
    run = ["run", "lab_n_b", "--no-report", "--out", str(folder / "run")]
    assert cli.main(run) == 0
    (folder / "few.toml").write_text(STUDY)
    (folder / "campaign").mkdir()
    (folder / "campaign" / "campaign.toml").write_text(CAMPAIGN)
    assert cli.main(["simulate", str(folder / "campaign"), "--out", str(folder / "measured")]) == 0
    return folder


CAMPAIGN = """name = "small"
rig = "both"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 10000.0
""" + "".join(
    f"""
[[stroke]]
file = "stroke_{k:03}.csv"
label = "fixed"
kind = "fixed"
supply_pressure_pa = {5e5 + 1e5 * k}
load = "none"
spring_n_per_m = 0.0
start_offset_m = 0.0
rest_s = 60.0
commands = [[0.01, "1", 0.98], [0.2, "1", 0.0]]
charged_before = []
"""
    for k in range(4)
)


def commands(made: Path) -> dict[str, list[str]]:
    """Every command that writes a folder, in a small form."""
    log, measured = str(made / "run" / "bus.log"), str(made / "measured")
    return {
        "run": ["run", "lab_n_b"],
        "run local": ["run", "lab_n_b", "--transport", "local", "--no-report"],
        "replay": ["replay", log],
        "whatif": ["whatif", str(made / "few.toml"), "--workers", "2"],
        "simulate": ["simulate", str(made / "campaign")],
        "diagnose": ["diagnose", measured, "--workers", "2"],
    }


def started(
    arguments: list[str], folder: Path, before: Callable[[], None] | None = None
) -> subprocess.Popen[str]:
    def prepare() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if before is not None:
            before()

    return subprocess.Popen(
        [sys.executable, "-m", "sil.cli", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=prepare,
    )


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def state(folder: Path) -> str:
    """What a folder says of itself: complete, why it is not, or nothing at all."""
    if not folder.exists() or not [p for p in folder.iterdir() if p.name != "previous"]:
        return "nothing"
    if (folder / INCOMPLETE).exists():
        return (folder / INCOMPLETE).read_text().strip()
    if (folder / "result.json").exists():
        result = json.loads((folder / "result.json").read_text())
        return "complete" if result["complete"] else str(result["why"])
    assert any((folder / name).exists() for name in (*LAST_WRITTEN, "campaign.toml"))
    return "complete"


NAMES = ("run", "run local", "replay", "whatif", "simulate", "diagnose")


def how_long(arguments: list[str], folder: Path) -> float:
    begun = time.monotonic()
    process = started(arguments, folder)
    process.communicate(timeout=300.0)
    return time.monotonic() - begun


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_killed_at_any_moment(name: str, made: Path, tmp_path: Path) -> None:
    """The folder says what it is, nothing lies elsewhere, and what was replaced is still there."""
    rng = random.Random(name)
    command = [*commands(made)[name], "--out", "out"]
    took_s = how_long(command, tmp_path)
    old = files(tmp_path / "out")
    assert state(tmp_path / "out") == "complete"
    for _ in range(4):
        process = started([*command, "--force"], tmp_path)
        time.sleep(rng.uniform(0.1, 1.1 * took_s))
        process.kill()
        process.communicate()
        label = state(tmp_path / "out")
        assert label == "complete" or "cut off" in label or label == "nothing"
        assert {p.name for p in tmp_path.iterdir()} <= {"out", "runs"}
        now = files(tmp_path / "out")
        if label == "complete":
            old = now
        for file in {"result.json", "diff.json", "results.csv", "diagnosis.json"} & set(old):
            assert old[file] in (now.get(file), now.get(f"previous/{file}"))
    process = started([*command, "--force"], tmp_path)
    assert process.communicate(timeout=300.0) and process.returncode in (0, 1)
    assert state(tmp_path / "out") == "complete" and not (tmp_path / "out" / "previous").exists()


INTERRUPTED = {
    **dict.fromkeys(NAMES),
    "convert": ["convert", "{made}/run/bus.log", "other.asc"],
    "fmu": ["fmu", "plant", "plant.fmu"],
    "identify": ["identify", "friction", "{made}/measured"],
    "bus": ["bus"],
    "node": ["node", "controller", "--channel", "local:nobody", "--scenario", "lab_n_b"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", INTERRUPTED)
def test_interrupted_at_any_moment(name: str, made: Path, tmp_path: Path) -> None:
    rng = random.Random(name)
    command = INTERRUPTED[name] or commands(made)[name]
    command = [word.format(made=made) for word in command]
    for wait_s in (0.4, rng.uniform(0.4, 1.5), rng.uniform(1.0, 4.0)):
        folder = tmp_path / f"{wait_s:.3f}"
        folder.mkdir()
        process = started(command, folder)
        time.sleep(wait_s)
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=120.0)
        lines = [line for line in output.splitlines() if "compiling" not in line]
        # -SIGINT: Python ends itself by the signal if it came in code run from a string, as of a
        # dataclass; for a shell that is 130, too
        assert process.returncode in (0, 1, 130, -signal.SIGINT), output
        assert "Traceback" not in output, output
        assert len(lines) <= 2, output
        if process.returncode == 130:
            assert "interrupted" in output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_and_leaves_nothing_behind(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Children ended, socket removed, no raw files, the folder marked incomplete, exit code of the signal."""
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    command = ["run", "lab_n_b", "--transport", "local:bench", "--speed", "0.02", "--out", "out"]
    process = started(command, tmp_path)
    log = tmp_path / "out" / "bus.log"
    while not log.exists() or log.stat().st_size < 1000:
        assert process.poll() is None
        time.sleep(0.02)
    tasks = Path(f"/proc/{process.pid}/task")
    children = [pid for task in tasks.iterdir() for pid in (task / "children").read_text().split()]
    assert len(children) == 2 and list((runtime / "opc4").iterdir())
    process.send_signal(number)
    _, lines = process.communicate(timeout=20.0)
    assert process.returncode == 128 + number and "Traceback" not in lines
    marked = "opc4 run: interrupted; out holds what was done, marked INCOMPLETE"
    assert lines.splitlines()[-1] == marked
    again = started(command, tmp_path)
    _, lines = again.communicate(timeout=60.0)
    assert again.returncode == 2 and lines.count("\n") == 1
    assert "another run, not complete (opc4 run: interrupted)" in lines
    assert not list((runtime / "opc4").iterdir())
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)
    assert state(tmp_path / "out") == "opc4 run: interrupted"
    assert json.loads((tmp_path / "out" / "result.json").read_text())["why"] == "interrupted"
    assert {p.name for p in (tmp_path / "out").iterdir()} <= {
        *("result.json", "bus.log", "trace.csv", "events.jsonl", "INCOMPLETE")
    }


def test_a_full_disk_ends_a_run_with_one_line_and_a_mark(tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    process = started(["run", "full_shift", "--no-report", "--out", "out"], tmp_path, limit)
    _, complaints = process.communicate(timeout=120.0)
    assert process.returncode == 3
    lines = [line for line in complaints.splitlines() if "compiling" not in line]
    assert len(lines) == 1 and "File too large: 'out/" in lines[0]
    assert lines[0].endswith("; out holds what was done, marked INCOMPLETE")
    assert "File too large" in state(tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("room", [100_000, 1_000])
def test_no_room_on_the_disk(name: str, room: int, made: Path, tmp_path: Path) -> None:
    """No file may grow beyond `room`, which ends a write as a full disk does."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    process = started([*commands(made)[name], "--out", "out"], tmp_path, limit)
    _, output = process.communicate(timeout=300.0)
    assert "Traceback" not in output, output
    assert process.returncode in (0, 1, 3), output
    if process.returncode == 3:
        assert "too large" in output
        # the first file, a picture or a stroke, is larger: nothing is left of it
        nothing = room == 1_000 or name in ("diagnose", "simulate")
        assert state(tmp_path / "out") not in ("complete", *([] if nothing else ["nothing"]))
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming nobody needs root")
def test_a_folder_of_somebody_else(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir(mode=0o755)
    os.chmod(tmp_path, 0o755)
    # nobody may not be allowed to read the interpreter's modules: load them all
    assert cli.main(["run", "lab_n_b", "--out", str(tmp_path / "own")]) == 0
    for out in ("theirs", "theirs/below"):
        pid = os.fork()
        if pid == 0:
            os.setgid(65534)
            os.setuid(65534)
            sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            os._exit(cli.main(["run", "lab_n_b", "--out", str(tmp_path / out)]))
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 2
    assert not list((tmp_path / "theirs").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "command"),
    [
        ("asammdf", ["convert", "{made}/run/trace.csv", "x.mf4"]),
        ("matplotlib", ["replay", "{made}/run/bus.log"]),
        ("cantools", ["replay", "{made}/run/bus.log", "--dbc", "{root}/can_dbc/opc4.dbc"]),
        ("pythonfmu3", ["fmu", "plant", "x.fmu"]),
        ("scipy", ["identify", "friction", "{made}/measured"]),
        ("jinja2", ["run", "lab_n_b"]),
        ("numba", ["simulate", "{made}/campaign"]),
    ],
)
def test_a_missing_library_is_named(
    library: str, command: list[str], made: Path, tmp_path: Path
) -> None:
    block = (
        f"import sys; sys.modules[{library!r}] = None; from sil.cli import main; sys.exit(main())"
    )
    words = [word.format(made=made, root=ROOT) for word in command]
    done = subprocess.run(
        [sys.executable, "-c", block, *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert done.returncode in (2, 3), done.stderr
    assert "Traceback" not in done.stderr
    assert library in done.stderr.splitlines()[-1]


READ_ONLY = """
import errno, os, sys

def refuse(event, given):
    if event == "open" and isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR):
        if str(given[0]).startswith(tuple(INSTALLATION)):
            raise OSError(errno.EROFS, "Read-only file system", given[0])

sys.addaudithook(refuse)
sys.path.insert(0, SITE)
from sil.cli import main
sys.exit(main(["run", "lab_n_b", "--out", "out"]))
"""

PACKAGES = ("sil", "plant", "controller", "can_dbc")


def run_read_only(folder: Path, site: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a scenario with the packages in `site`, where nothing may be written, without a home."""
    installation = [str(site / name) for name in PACKAGES]
    code = f"INSTALLATION, SITE = {installation}, {str(site)!r}{READ_ONLY}"
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder, capture_output=True, text=True, timeout=600, check=False,
        env={"PATH": os.environ["PATH"], "HOME": "/dev/null/none", **environment},
    )  # fmt: skip


def test_a_run_needs_no_home_and_writes_nothing_into_the_installation(tmp_path: Path) -> None:
    done = run_read_only(tmp_path, ROOT, NUMBA_CACHE_DIR=str(cache_folder().parent))  # warm
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder into which the project's wheel is installed."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", source, source], check=True)
    (wheel,) = source.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)
    return site


@pytest.mark.slow
def test_an_installed_wheel_needs_no_home_either(tmp_path: Path, installed: Path) -> None:
    before = sorted(installed.rglob("*"))
    done = run_read_only(tmp_path, installed)
    assert done.returncode == 0, done.stderr
    told, compiling = done.stderr.splitlines()
    assert "/dev/null/none" in told and "the compiled equations go to" in told
    assert "compiling the plant's equations" in compiling
    assert (tmp_path / "out" / "report.html").is_file()
    assert sorted(installed.rglob("*")) == before
