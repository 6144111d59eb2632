"""Every file and command in README and how-to guides, in order, one folder per page."""

from __future__ import annotations

import contextlib
import io
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT, Run, run_opc4
from tests.docs.pages import PAGES, blocks, commands

SHELL = ("sh", "text", "console")
GUIDES = [
    page
    for page, path in PAGES.items()
    if page.startswith(("README.md", "docs/how-to/", "docs/explanation/why_feedback_fails.md"))
    and page != "docs/how-to/python.md"
    and any(block.language in SHELL and "opc4 " in block.text for block in blocks(path))
]


def tutorial_file(name: str) -> str:
    """Return a file that the tutorial writes."""
    (found,) = (b.text for b in blocks(PAGES["docs/tutorial.md"]) if b.file == name)
    return found


def make_measured(folder: Path) -> None:
    """Make the folder of a reader: a measured campaign and a firmware of their own."""
    (folder / "own.py").write_text(tutorial_file("own.py"), encoding="utf-8")
    (folder / "plan").mkdir()
    plan = tutorial_file("plan/campaign.toml")
    (folder / "plan" / "campaign.toml").write_text(plan, encoding="utf-8")
    done = run_opc4(folder, "simulate", "plan", "--set", "valve.D_rise=0.013", "--out", "measured")
    assert done.returncode == 0, done.stderr


def serve_and_end(folder: Path, arguments: list[str]) -> None:
    """Start the live bench, and end it as Ctrl-C does once it has its address."""

    def prepare() -> None:  # tests in the background of a shell inherit that interrupts are ignored
        signal.signal(signal.SIGINT, signal.default_int_handler)

    command = [sys.executable, "-m", "sil.cli", "live", "--no-browser", *arguments]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, text=True, preexec_fn=prepare
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("http://127.0.0.1:")
            process.send_signal(signal.SIGINT)
            assert process.wait(240.0) == 0
        finally:
            process.kill()


def test_guides_are_found() -> None:
    assert len(GUIDES) >= 5


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDES)
def test_commands_do_what_the_page_says(page: str, tmp_path: Path) -> None:
    if page == "docs/how-to/firmware-in-c.md":
        pytest.importorskip("ziglang", reason="extra c")
    make_measured(tmp_path)
    background: list[subprocess.Popen[bytes]] = []
    for block in blocks(PAGES[page]):
        if block.file is not None:
            (tmp_path / block.file).parent.mkdir(exist_ok=True)
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        if block.language not in SHELL:
            continue
        for words, stated in commands(block.text):
            if words[0] == "python" and words[-1] == "&":
                background.append(subprocess.Popen([sys.executable, *words[1:-1]], cwd=tmp_path))
            if words[0] != "opc4":
                continue
            if words[1] == "live":
                serve_and_end(tmp_path, words[2:])
                continue
            done = run_opc4(tmp_path, *words[1:], timeout=1200.0)
            # a changed value may break an expectation, but is never an error
            allowed = (0, 1) if stated is None else (stated,)
            assert done.returncode in allowed, f"{' '.join(words)}: {done.stdout}{done.stderr}"
            assert "Traceback" not in done.stderr
    assert [process.wait(60.0) for process in background] == [0] * len(background)


def test_the_readme_shows_what_a_run_prints(opc4: Run) -> None:
    (shown,) = (b.text for b in blocks(PAGES["README.md"]) if b.language == "text")
    command, *lines = shown.splitlines()
    done = opc4(*command.removeprefix("$ opc4 ").split())
    assert done.stdout.splitlines() == lines


def test_the_python_in_the_readme_prints_what_it_says() -> None:
    (text,) = (b.text for b in blocks(PAGES["README.md"]) if b.language == "python")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(text, "README", "exec"), {})
    stated = float(text.rpartition("#")[2])
    assert float(printed.getvalue()) == pytest.approx(stated, abs=5e-4)


@pytest.mark.slow
def test_make_demo(tmp_path: Path) -> None:
    """Make the demo with what is installed."""
    assert shutil.which("make")
    done = subprocess.run(
        ["make", "-o", ".venv/.run", "demo", f"DEMO={tmp_path / 'demo'}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "shift.png").exists() and "page:" in done.stdout
