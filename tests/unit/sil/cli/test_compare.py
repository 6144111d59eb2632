"""Runs beside each other: metrics, events, traces, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sil.cli import main
from sil.report.compare_page import compare_figure
from sil.simulation.kept_run import COLUMNS, read_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outputs = tmp_path_factory.mktemp("runs")
    for name, extra in (("a", []), ("b", []), ("late", ["--set", "valve.D_rise=12ms"])):
        assert main(["run", "lab_n_b", *extra, "--no-report", "--out", str(outputs / name)]) == 0
    return outputs


def compared(capsys: pytest.CaptureFixture[str], *words: Path | str) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    return main(["compare", *map(str, words), "--json"]), json.loads(capsys.readouterr().out)


def test_a_later_valve_moves_events_and_metrics_by_its_delay(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    runs = (folder / "a", folder / "late" / "result.json")
    code, report = compared(capsys, *runs, "--out", out)
    assert code == 0 and not report["traces_equal"]
    metrics = {row["name"]: row for row in report["metrics"]}
    assert metrics["shift_time_s"]["differences"][1] == pytest.approx(0.004, abs=1e-6)
    events = {row["name"]: row["after_request_s"] for row in report["events"]}
    for name in ("valve B open", "first motion", "stay stop", "arrived"):
        before_s, after_s = events[name]
        assert after_s - before_s == pytest.approx(0.004, abs=1e-6)
    assert "coil B on" not in events and "commanded" not in events
    files = {"compare.json", "compare.png", "compare.svg", "report.html"}
    assert {p.name for p in out.iterdir()} == files
    assert "valve B open" in (out / "report.html").read_text(encoding="utf-8")


def test_exact_tells_equal_traces_from_others(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, late = (folder / name for name in ("a", "b", "late"))
    code, report = compared(capsys, a, b, "--exact", "--out", tmp_path / "equal")
    assert code == 0 and report["traces_equal"] and report["events"] == []
    assert compared(capsys, a, b, late, "--exact", "--out", tmp_path / "other")[0] == 1


def test_traces_are_aligned_at_the_request(folder: Path) -> None:
    (stack,) = compare_figure([read_run(folder / name, name) for name in ("a", "late")]).stacks
    named = [series for series in stack.panels[0].series if series.label]
    assert [series.label for series in named] == ["a", "late"]
    reached_ms = [float(series.x[series.y > 12.8][0]) for series in named]
    assert reached_ms[0] == pytest.approx(51.1, abs=0.5)
    assert reached_ms[1] - reached_ms[0] == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("result.json", "{", "not JSON; expected the result.json of a run"),
        ("result.json", '{"scenario_name": "x"}', "complete: missing; expected true or false"),
        ("trace.csv", "a,b\n1,2\n3,4\n", "no time_s; expected the trace.csv of a run"),
        ("trace.csv", f"{','.join(COLUMNS)}\n1,2\n1\n", "not a table of numbers; expected"),
        ("events.jsonl", "5\n", "not an event; expected time_s, name and values"),
        ("trace.csv", None, "no such file; expected the trace of a run"),
    ],
)
def test_what_is_not_a_run_is_one_line(
    name: str,
    content: str | None,
    said: str,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for file in (folder / "a").iterdir():
        (damaged / file.name).write_bytes(file.read_bytes())
    (damaged / name).unlink()
    if content is not None:
        (damaged / name).write_text(content)
    capsys.readouterr()
    assert main(["compare", str(folder / "a"), str(damaged), "--out", str(tmp_path / "o")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line and said in line and not (tmp_path / "o").exists()
    assert main(["compare", str(folder / "a")]) == 2
    assert "one run; expected two or more" in capsys.readouterr().err
