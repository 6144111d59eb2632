"""The swarm: the same runs wherever it runs, and a bug found, shrunk, and failing by itself."""

from __future__ import annotations

import json
import math
import random
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from can_dbc.errors import InputError
from sil import cli
from sil.cli.swarm import news
from sil.files.worker import in_turn
from sil.firmware.load import SHIPPED_IN_C
from sil.rules import Violation
from sil.rules.shipped import RULES
from sil.rules.user_file import load_rules
from sil.simulation.load_scenario import from_table
from sil.swarm.draw import new_table
from sil.swarm.hunt import SWARM_FILE, Generation, Hunt, stored_generations
from sil.swarm.shrink import shrink
from tests.support.firmware_bugs import BUGS, mutants, with_bug

BASE: dict[str, Any] = {"name": "swarm", "duration_s": 1.0, "request": []}


def hunted(workers: int, generations: int, hunt: Hunt | None = None) -> Hunt:
    hunt = hunt or Hunt(BASE, 3, RULES, size=8)
    list(hunt.run(partial(in_turn, workers=workers), 8 * generations, math.inf))
    return hunt


def comparable(hunt: Hunt) -> list[Any]:
    return [msgspec.to_builtins(msgspec.structs.replace(g, wall_s=0.0)) for g in hunt.generations]


def test_what_is_drawn_is_a_scenario() -> None:
    rng, kinds = random.Random(5), set()
    for _ in range(150):
        table = new_table(rng, BASE)
        scenario = from_table(table, "drawn").scenario
        kinds.update(key for key in table if key.endswith(("fault", "clock")))
        assert scenario.request
    tables = {"fault", "sensor_fault", "temperature_fault", "speed_fault", "valve_fault", "clock"}
    assert kinds == tables


def test_one_worker_two_or_an_interruption_make_no_difference(tmp_path: Path) -> None:
    whole = hunted(1, 3)
    for each in whole.generations:
        assert len(each.transitions) > 5 and set(each.shortest) == set(each.transitions)
    assert comparable(hunted(2, 3)) == comparable(whole)
    first = hunted(1, 1)
    lines = [json.dumps({"sha256": first.digest}).encode()]
    lines += [msgspec.json.encode(generation) for generation in first.generations]
    (tmp_path / SWARM_FILE).write_bytes(b"\n".join(lines) + b"\n" + lines[-1][:40])  # torn
    resumed = Hunt(BASE, 3, RULES, size=8)
    for generation in stored_generations(tmp_path, resumed.digest):
        resumed.add(generation)
    assert comparable(hunted(1, 3, resumed)) == comparable(whole)
    with pytest.raises(InputError, match="another target, seed"):
        stored_generations(tmp_path, Hunt(BASE, 4, RULES, size=8).digest)
    with pytest.raises(InputError, match=f"no {SWARM_FILE}"):
        stored_generations(tmp_path / "none", whole.digest)


def test_shrinking_leaves_what_is_needed() -> None:
    table = new_table(random.Random(1), BASE)
    table["duration_s"] = 4.0
    table["request"] = [{"at_s": 0.1234, "gear": "forward"}, {"at_s": 0.9876, "gear": "neutral"}]
    table["valve_fault"] = [
        {"valve": "B", "kind": "stuck", "start_s": 0.2345, "end_s": 0.7},
        {"valve": "F", "kind": "stuck", "start_s": 0.2345, "end_s": 0.7},
    ]

    def broken(candidate: Any) -> Violation | None:
        valves = [fault.get("valve") for fault in candidate.get("valve_fault", ())]
        gears = [request["gear"] for request in candidate["request"]]
        return Violation("rule", 0.5, "") if "F" in valves and "forward" in gears else None

    assert shrink(table, broken) == {
        "name": "swarm",
        "seed": 1,
        "duration_s": 0.6,
        "trace_period_s": 0.001,
        "initial_gear": table["initial_gear"],
        "request": [{"at_s": 0.0, "gear": "forward"}],
        "valve_fault": [{"valve": "F", "kind": "stuck"}],
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lab_n_b"], "neither --runs nor --hours; expected one of them"),
        (["lab_n_b", "--runs", "0"], "--runs 0"),
        (["none", "--runs", "1"], "none: scenario: "),
        (["none.py", "--runs", "1"], "no such file"),
        (["empty.py", "--runs", "1"], "empty.py:1: LookupError: no class 'Firmware'"),
        (["loop.py", "--runs", "1"], "loop.py: no such file"),
        ([".", "--runs", "1"], "is a folder; expected FILE.py"),
        (["lab_n_b", "--runs", "1", "--resume"], "--resume: no folder"),
        (["lab_n_b", "--runs", "1", "--workers", "0"], "--workers 0"),
    ],
)
def test_wrong_arguments_end_in_one_line(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "empty.py").write_text("")
    (tmp_path / "loop.py").symlink_to("loop.py")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["swarm", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.slow
def test_a_cluster_interruptions_and_two_workers_make_no_difference(tmp_path: Path) -> None:
    """Rules of one's own and a firmware in C included; broken in every generation."""
    pytest.importorskip("wasmtime", reason="extra c")
    pytest.importorskip("ziglang", reason="extra c")
    from distributed import LocalCluster

    file = tmp_path / "rules.py"
    file.write_text(
        "from sil.rules import Rule\n"
        "RULES = [Rule('no_fault', 'No fault.', 'me', lambda record, c: next("
        "((e.time_s, e.name) for e in record.events if e.name == 'stay_stop'), None))]\n"
    )
    base = BASE | {"firmware": str(SHIPPED_IN_C)}

    def hunt() -> Hunt:
        return Hunt(base, 5, load_rules(str(file)), size=8)

    whole = hunted(1, 2, hunt())
    assert [failure.rule for g in whole.generations for failure in g.failures][:1] == ["no_fault"]
    assert comparable(hunted(2, 2, hunt())) == comparable(whole)
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        runner = partial(in_turn, cluster=cluster.scheduler_address)
        spread = hunt()
        spread.add(whole.generations[0])
        list(spread.run(runner, 16, math.inf))
    assert comparable(spread) == comparable(whole)


@pytest.mark.slow
def test_a_bug_is_found_and_fails_by_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("wasmtime", reason="extra c")
    pytest.importorskip("ziglang", reason="extra c")
    firmware = with_bug(BUGS["timeout_off_by_one"], tmp_path / "firmware")
    out = tmp_path / "out"
    command = ["swarm", str(firmware), "--runs", "256", "--workers", "2", "--out", str(out)]
    assert cli.main(command) == 1
    assert "too_many_attempts" in capsys.readouterr().out
    file = next((out / "failures").glob("too_many_attempts_*.toml"))
    assert file.with_suffix(".png").exists() and (out / "report.html").exists()
    assert cli.main(["run", str(file), "--no-report", "--out", str(tmp_path / "run")]) == 1
    assert "rules broken" in capsys.readouterr().out
    (tmp_path / "mended.toml").write_text(file.read_text().replace(str(firmware), "c"))
    mended = ["run", str(tmp_path / "mended.toml"), "--no-report", "--out", str(tmp_path / "run2")]
    assert cli.main(mended) == 0


def test_progress_says_what_is_new() -> None:
    def generation(number: int, wall_s: float, *names: str) -> Generation:
        transitions = dict.fromkeys(names, 1)
        return Generation(
            number=number, runs=256, refused=0, wall_s=wall_s, transitions=transitions,
            shortest={}, failures=[], broken={},
        )  # fmt: skip

    hunt = Hunt(BASE, 1, RULES)
    for each in (
        generation(0, 100.0, "a"),
        generation(1, 500.0, "a", "b"),
        generation(2, 100.0, "b", "c"),
    ):
        hunt.add(each)
    assert news(hunt) == "768 runs, 1.1 a second, 2 new transitions in the last 10 min, 0 failures"


def test_every_bug_and_mutant_is_a_change_of_the_source(tmp_path: Path) -> None:
    changes = {**BUGS, **mutants()}
    assert len(changes) == 20 and len(set(changes.values())) == 20
    for number, bug in enumerate(changes.values()):
        changed = with_bug(bug, tmp_path / str(number)).parent / bug.file
        assert bug.wrong in changed.read_text() and bug.wrong != bug.right
