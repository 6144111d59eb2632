"""Run folders, result.json and JUnit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from can_dbc.errors import InputError
from sil.files.output_folder import begin, finite, prepare_folder, settle, write_whole
from sil.simulation.results import Check, Result, as_json, junit_xml, versions


def made(**changes: object) -> Result:
    fields: dict[str, object] = {
        "scenario_name": "example",
        "passed": True,
        "complete": True,
        "why": None,
        "expectations": [Check(name="final gear", passed=True, value="neutral", limit="neutral")],
        "metrics": {"shift_time_s": 0.1},
        "trace_sha256": "0" * 64,
        "seed": 1,
        "transport": "inproc",
        "versions": {},
        "bus": {},
        "balances": {},
        "speed": {"wall_s": 0.5},
        "scenario": {},
        "model": {},
        "status": "passed",
    }
    return Result(**(fields | changes))  # type: ignore[arg-type]


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


def test_a_folder_says_that_it_is_not_complete_until_it_is(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    assert prepare_folder(out, "x", False) == out
    assert tree(out) == {"INCOMPLETE": "cut off before it could say why\n"}
    put(out, diff_txt="half")
    assert settle("interrupted") == []
    assert tree(out) == {"INCOMPLETE": "interrupted\n", "diff.txt": "half"}
    with pytest.raises(InputError, match=r"holds another run \(INCOMPLETE\)"):
        prepare_folder(out, "x", False)
    begin(out)
    assert settle(None) == [] and tree(out) == {"diff.txt": "half"}
    assert prepare_folder(tmp_path / "empty", "x", False, says_itself=True).is_dir()
    assert settle("bad input") == [] and not (tmp_path / "empty").exists()


def test_nothing_is_lost_before_the_new_run_stands(tmp_path: Path) -> None:
    old = {"result.json": '{"complete": true}', "bus.log": "old", "notes.txt": "mine"}
    put(tmp_path, result_json=old["result.json"], bus_log="old", notes_txt="mine")
    with pytest.raises(InputError, match=r"holds another run \(bus.log\)"):
        prepare_folder(tmp_path, "x", False)
    prepare_folder(tmp_path, "x", True, says_itself=True)
    assert set(tree(tmp_path)) == {"notes.txt", "previous/result.json", "previous/bus.log"}
    assert settle("bad input") == [] and tree(tmp_path) == old  # nothing came of it
    for begun in ("new", "newer"):  # twice killed in the middle
        prepare_folder(tmp_path, "x", True, says_itself=True)
        put(tmp_path, result_json='{"complete": false}', bus_log=begun)
        kept = f"the run that was there before is in {tmp_path / 'previous'}"
        assert settle("killed") == [kept]
        assert tree(tmp_path)["bus.log"] == begun and tree(tmp_path)["previous/bus.log"] == "old"
    prepare_folder(tmp_path, "x", True, says_itself=True)
    put(tmp_path, result_json='{"complete": true}', bus_log="newest")
    assert settle(None) == []
    assert tree(tmp_path) == old | {"bus.log": "newest"}


def test_links_of_our_names_are_not_followed(tmp_path: Path) -> None:
    (outside := tmp_path / "outside").write_text("mine")
    (out := tmp_path / "out").mkdir()
    for name in ("result.json", "result.json.part", "previous"):
        (out / name).symlink_to(outside)
    with pytest.raises(InputError, match="previous: not a folder"):
        prepare_folder(out, "x", True)
    (out / "previous").unlink()
    write_whole(prepare_folder(out, "x", True) / "result.json", "{}")
    settle(None)
    assert outside.read_text() == "mine" and not (out / "result.json").is_symlink()


def test_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        prepare_folder(tmp_path / "file", "x", False)
    with pytest.raises(InputError, match="expected a folder"):
        prepare_folder(tmp_path / "file" / "below", "x", False)


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    write_whole(target, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(target, "new \ud800")
    assert target.read_text() == "old"
    write_whole(target, "new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == [
        "result.json",
    ]


def test_json_has_no_nan_and_the_promised_names() -> None:
    told = json.loads(as_json(made(metrics={"a": float("nan"), "b": [float("inf"), 1.0]})))
    assert told["metrics"] == {"a": None, "b": [None, 1.0]}
    assert {
        "passed",
        "expectations",
        "metrics",
        "trace_sha256",
        "seed",
        "versions",
        "scenario",
    } <= (told.keys())
    assert finite({1: (float("-inf"), "x")}) == {"1": [None, "x"]}


def test_versions_name_the_libraries_a_result_depends_on() -> None:
    assert {"python", "numpy", "numba", "python-can"} <= versions().keys()


def test_junit_counts_failures_and_an_unfinished_run() -> None:
    bad = Check(name='<a> & "b"', passed=False, value=None, limit={"max": 1.0})
    text = junit_xml(made(expectations=[*made().expectations, bad], passed=False))
    suite = ElementTree.fromstring(text.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    assert [c.get("name") for c in suite] == ["final gear", '<a> & "b"']
    ended = junit_xml(made(complete=False, why="plant was killed\x00", passed=False))
    suite = ElementTree.fromstring(ended.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("errors")) == ("2", "1")
    error = suite.find("testcase[@name='run finished']/error")
    assert error is not None and error.get("message") == "plant was killed?"


def test_a_way_back_makes_no_folder_on_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    folder = prepare_folder(Path("a/../../b/c"), "run", False)
    assert folder == Path("../b/c") and folder.is_dir()
    assert not Path("a").exists()
