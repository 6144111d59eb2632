"""Files of an output folder: whole or not at all, and refused where others live."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil import cli
from sil.files import extras, output_folder, progress
from sil.files.atomic import open_atomically, write_atomically
from sil.files.output_folder import close_folders, locked_folder, prepare_folder, reopen_folder
from tests.conftest import ROOT


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    close_folders(None)


def test_default_folders_are_numbered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [prepare_folder(None, "a b/../c", False) for _ in range(3)]
    assert [str(f) for f in folders] == ["runs/a-b-..-c-1", "runs/a-b-..-c-2", "runs/a-b-..-c-3"]
    assert prepare_folder(None, "..", False) == Path("runs/run-1")


def put(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)


def tree(folder: Path) -> dict[str, str]:
    found = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p.relative_to(folder)): p.read_text() for p in found}


def test_a_folder_is_marked_as_incomplete_until_it_is_closed(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    assert prepare_folder(out, "x", False) == out
    assert tree(out) == {"INCOMPLETE": "cut off before it could say why\n"}
    put(out, diff_txt="half")
    assert close_folders("interrupted") == [f"{out} holds what was done, marked INCOMPLETE"]
    assert tree(out) == {"INCOMPLETE": "interrupted\n", "diff.txt": "half"}
    with pytest.raises(InputError, match=r"holds another run, not complete \(interrupted\)"):
        prepare_folder(out, "x", False)
    assert reopen_folder(out) == out
    assert close_folders(None) == [] and tree(out) == {"diff.txt": "half"}
    assert prepare_folder(tmp_path / "empty", "x", False).is_dir()
    assert close_folders("bad input") == [] and not (tmp_path / "empty").exists()


def test_a_marked_run_does_not_replace_a_complete_one(tmp_path: Path) -> None:
    """A run killed between its result and its end is not complete, whatever its result says."""
    out, complete = tmp_path / "run", '{"complete": true}'
    put(out, result_json=complete + " ", INCOMPLETE="cut off")
    put(out / "previous", result_json=complete)
    prepare_folder(out, "x", True)
    assert (out / "previous" / "result.json").read_text() == complete
    assert not (out / "result.json").exists()
    close_folders(None)
    shutil.rmtree(out)
    # a complete one replaces what was marked
    put(out, result_json=complete)
    put(out / "previous", trace_csv="half", INCOMPLETE="cut off")
    prepare_folder(out, "x", True)
    assert tree(out / "previous") == {"result.json": complete, "trace.csv": "half"}


def test_a_replaced_run_is_kept_until_the_new_one_is_complete(tmp_path: Path) -> None:
    old = {"result.json": '{"complete": true}', "bus.log": "old", "notes.txt": "mine"}
    put(tmp_path, result_json=old["result.json"], bus_log="old", notes_txt="mine")
    with pytest.raises(InputError, match=r"holds another run \(bus.log\)"):
        prepare_folder(tmp_path, "x", False)
    prepare_folder(tmp_path, "x", True)
    previous = {"previous/result.json", "previous/bus.log"}
    assert set(tree(tmp_path)) == {"notes.txt", "INCOMPLETE", *previous}
    assert close_folders("bad input") == [] and tree(tmp_path) == old  # nothing came of it
    for begun in ("new", "newer"):  # twice killed in the middle
        prepare_folder(tmp_path, "x", True)
        put(tmp_path, result_json='{"complete": false}', bus_log=begun)
        kept = f"the previous run is in {tmp_path / 'previous'}"
        assert close_folders("killed")[1:] == [kept]
        assert tree(tmp_path)["bus.log"] == begun and tree(tmp_path)["previous/bus.log"] == "old"
    prepare_folder(tmp_path, "x", True)
    put(tmp_path, result_json='{"complete": true}', bus_log="newest")
    assert close_folders(None) == []
    assert tree(tmp_path) == old | {"bus.log": "newest"}


@pytest.mark.parametrize("words", [["replay"], ["replay", "--summary"], ["diagnose"]])
def test_a_log_is_not_deleted_by_the_command_that_reads_it(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert cli.main(["run", "full_shift", "--no-report", "--out", str(run)]) == 0
    log = run / "bus.log"
    assert cli.main([*words, str(log), "--out", str(run), "--force"]) == 2
    what = f"--force would delete {log}, which is read; expected another folder"
    assert capsys.readouterr().err.splitlines()[-1] == f"opc4 {words[0]}: {run}: --out: {what}"
    assert log.exists() and (run / "result.json").exists()


def test_links_of_our_names_are_not_followed(tmp_path: Path) -> None:
    (outside := tmp_path / "outside").write_text("mine")
    (out := tmp_path / "out").mkdir()
    for name in ("result.json", "result.json.part", "previous"):
        (out / name).symlink_to(outside)
    with pytest.raises(InputError, match="previous: not a folder"):
        prepare_folder(out, "x", True)
    (out / "previous").unlink()
    write_atomically(prepare_folder(out, "x", True) / "result.json", "{}")
    close_folders(None)
    assert outside.read_text() == "mine" and not (out / "result.json").is_symlink()


def test_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        prepare_folder(tmp_path / "file", "x", False)
    with pytest.raises(InputError, match="expected a folder"):
        prepare_folder(tmp_path / "file" / "below", "x", False)


def test_parent_steps_in_a_path_make_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    folder = prepare_folder(Path("a/../../b/c"), "run", False)
    assert folder == Path("../b/c") and folder.is_dir()
    assert not Path("a").exists()


HOLDER = """
import sys, time
from pathlib import Path
from sil.files.output_folder import prepare_folder, close_folders
folder = prepare_folder(Path(sys.argv[1]) if len(sys.argv) > 1 else None, "x", True)
print(folder, flush=True)
sys.stdin.read()
close_folders(None)
"""


def holder(folder: Path, *out: str) -> subprocess.Popen[str]:
    """Start a process that writes into an output folder until its input ends."""
    return subprocess.Popen(
        [sys.executable, "-c", HOLDER, *out],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("killed", [False, True])
def test_a_second_run_into_one_folder_is_refused_while_the_first_lives(
    killed: bool, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with holder(tmp_path, str(out)) as first:
        assert first.stdout is not None and first.stdout.readline() == f"{out}\n"
        before = tree(out)
        for force in (False, True):
            with pytest.raises(InputError, match="out: --out: another run is writing here"):
                prepare_folder(out, "x", force)
        with pytest.raises(InputError, match="another run is writing here"):
            reopen_folder(out)
        with pytest.raises(InputError, match="another run"), locked_folder(out):
            pass
        assert tree(out) == before
        if killed:
            first.kill()
        else:
            first.communicate()
            assert not list(out.iterdir())
    assert prepare_folder(out, "x", True) == out


def test_a_worker_process_does_not_hold_the_lock(tmp_path: Path) -> None:
    prepare_folder(tmp_path, "x", True)
    started = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.write(started[1], b"x")
        signal.pause()
    os.read(started[0], 1)
    try:
        os.close(output_folder._open_folders.pop()[1])  # as when its process is killed
        assert prepare_folder(tmp_path, "x", True) == tmp_path
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)


def test_runs_that_start_at_once_get_different_numbers(tmp_path: Path) -> None:
    processes = [holder(tmp_path) for _ in range(4)]
    names = {p.stdout.readline().strip() for p in processes if p.stdout is not None}
    for process in processes:
        process.communicate()
    assert names == {f"runs/x-{n}" for n in range(1, 5)}


def test_the_lock_of_a_removed_folder_is_not_taken_for_the_new_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare_folder(out, "x", False)
    shutil.rmtree(out)
    assert prepare_folder(out, "y", False) == out
    assert close_folders("bad input") == [] and not out.exists()


COMMANDS = [["run", "lab_n_b"], ["replay", "{golden}/lab_n_b.log.gz"], ["whatif", "sensor_delay"]]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
def test_commands_refuse_a_folder_in_use(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = [word.format(golden=ROOT / "tests" / "golden") for word in command]
    with holder(tmp_path, str(out)) as first:
        assert first.stdout is not None and first.stdout.readline()
        assert cli.main([*words, "--out", str(out), "--force"]) == 2
        lines = capsys.readouterr().err.splitlines()
        first.communicate()
    assert len(lines) == 1 and "another run is writing here" in lines[0]


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    write_atomically(target, "old")
    with pytest.raises(KeyboardInterrupt), open_atomically(target) as file:
        file.write(b"new")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    write_atomically(target, "new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["result.json"]


def test_a_name_that_is_not_utf8_is_written_as_json_escapes_it(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.json", '"\udcff.py"')
    assert json.loads((tmp_path / "a.json").read_text()) == "\udcff.py"


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    """A process that writes the same file meanwhile replaces it as a whole."""
    target = tmp_path / "out.fmu"
    with open_atomically(target) as file:
        file.write(b"first " * 1000)
        pid = os.fork()
        if pid == 0:
            write_atomically(target, "second")
            os._exit(0)
        os.waitpid(pid, 0)
        assert target.read_text() == "second"
    assert target.read_bytes() == b"first " * 1000 and os.listdir(tmp_path) == ["out.fmu"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "_silent", False)  # whatever command has run here with --quiet
    return now


def shown(clock: list[float], stream: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.Progress("rows") as report:
        for second in range(30):
            clock[0] = 100.0 + second
            report(second, 40)
    return stream.getvalue()


def test_a_line_after_two_seconds_and_then_every_ten(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = shown(clock, io.StringIO(), monkeypatch).splitlines()
    assert lines == [
        "rows: 5 % (2 of 40), 1/s, 38 s left",
        "rows: 30 % (12 of 40), 1/s, 28 s left",
        "rows: 55 % (22 of 40), 1/s, 18 s left",
    ]


def test_a_bar_on_a_terminal_that_is_removed_at_the_end(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = shown(clock, Terminal(), monkeypatch)
    bars = text.split("\r")
    assert "\n" not in text and len(bars) == 31
    assert bars[-3].startswith("[######################........] rows: 72 %") and bars[-1] == ""


def test_none_of_quick_work_and_none_when_silent(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.Progress("rows") as report:
        report(1, 2)
    assert stream.getvalue() == ""
    progress.silence()
    assert shown(clock, io.StringIO(), monkeypatch) == ""


def test_in_a_clone_the_command_installs_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(extras.ROOT)
    monkeypatch.setattr("sys.executable", str(extras.ROOT / ".venv" / "bin" / "python"))
    expected = (
        "log.mf4: MF4 needs no_such_module, which is not installed; expected it after: "
        ".venv/bin/python -m pip install -e '.[mdf]'"
    )
    with pytest.raises(InputError) as caught:
        extras.import_extra("no_such_module", "mdf", "log.mf4: MF4")
    assert str(caught.value) == expected


def test_elsewhere_the_command_installs_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "ROOT", tmp_path)
    assert extras.install_command("fmpy", "fmu").endswith(" -m pip install fmpy")
