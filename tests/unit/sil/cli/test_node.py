"""`opc4 node`: what it waits for and what it refuses."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from sil import cli
from sil.simulation import build, load_scenario, scenario

pytestmark = pytest.mark.usefixtures("runtime_folder")


def test_a_node_says_at_once_what_it_waits_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["node", "controller", "--channel", "local:nobody", "--timeout", "0.1"]) == 3
    assert capsys.readouterr().err.splitlines() == [
        "opc4 node: waiting up to 0.1 s for a run on local:nobody",
        "opc4 node: no run on local:nobody within 0.1 s",
    ]


@pytest.mark.parametrize(
    ("channel", "what"),
    [
        ("local:", "expected a name"),
        ("local:a b", "expected a name"),
        ("local:/no/such/folder/bus", "no folder /no/such/folder"),
        ("local:/dev/null", "is no socket"),
        ("locale", "name of a CAN interface"),
    ],
)
def test_a_channel_that_cannot_exist_is_refused_at_once(
    channel: str, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["node", "controller", "--channel", channel]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert repr(channel.removeprefix("local:")) in line and what in line


@pytest.mark.parametrize("value", ["-1", "nan", "1e9"])
def test_a_timeout_that_cannot_be_is_refused(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["node", "plant", "--channel", "local:x", "--timeout", value]) == 2
    assert "--timeout" in capsys.readouterr().err


def test_node_on_no_channel_and_over_records_of_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["node", "controller", "--channel", "nocan9"]) == 2
    assert "nocan9" in capsys.readouterr().err
    assert cli.main(["node", "driver", "--channel", "local:x"]) == 2
    out = tmp_path / "made"
    assert cli.main(["node", "plant", "--channel", "nocan9", "--out", str(out)]) == 2
    assert "nocan9" in capsys.readouterr().err and not out.exists()
    (tmp_path / "plant.trace").write_text("")
    assert cli.main(["node", "plant", "--channel", "local:x", "--out", str(tmp_path)]) == 2
    assert "plant.trace: exists" in capsys.readouterr().err


def test_a_participants_process_runs_this_code_whatever_lies_around(tmp_path: Path) -> None:
    for name in ("sil", "controller", "can_dbc"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('another program')")
    (tmp_path / build.SCENARIO).write_text(
        json.dumps({"scenario": scenario.expanded(load_scenario.load("lab_n_b").scenario)})
    )
    command = build.node_command("controller", "nocan9", tmp_path)
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 2 and "nocan9" in done.stderr


def test_a_duration_is_for_a_node_in_real_time(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["node", "controller", "--channel", "local:x", "--duration"]
    for more in (["5"], ["0", "--realtime"]):
        assert cli.main([*words, *more]) == 2
        assert "expected 0 to 86400 s, and --realtime" in capsys.readouterr().err
