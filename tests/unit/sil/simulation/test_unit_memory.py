"""The memory of the control unit: a file at power-on, a file at power-off, the same on all ways."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table, load, read
from sil.simulation.runner import run
from sil.simulation.unit_memory import content, embedded

LEARNED = ['controller.strategy="learned"']


def test_a_run_leaves_the_memory_with_which_the_next_begins(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    loaded = load("lab_n_b", settings=LEARNED)
    run(loaded, tmp_path / "first")
    left = (tmp_path / "first/memory.bin").read_bytes()
    in_memory = run_in_memory(loaded)
    assert left == in_memory.memory != run_in_memory(loaded, left).memory
    table, _ = read("lab_n_b")
    table["controller"] = table.get("controller", {}) | {"strategy": "learned"}
    chained = from_table(table | {"memory": "first/memory.bin"}, "chained", folder=tmp_path)
    assert run_in_memory(chained).memory == run_in_memory(loaded, left).memory
    run(chained, tmp_path / "second", transport="local")
    again = load(str(tmp_path / "second/result.json"))
    assert content(again.scenario.memory) == left
    assert (tmp_path / "second/memory.bin").read_bytes() == run_in_memory(again).memory


def test_other_strategies_leave_none(tmp_path: Path) -> None:
    run(load("lab_n_b"), tmp_path)
    assert not (tmp_path / "memory.bin").exists()
    assert run_in_memory(load("lab_n_b")).memory == b""


@pytest.mark.parametrize(
    ("memory", "said"),
    [
        ("none.bin", "here: memory: FOLDER/none.bin: No such file or directory; expected a file"),
        ("", "here: memory: FOLDER: Is a directory; expected a file"),
        ("nul\0", "here: memory: no file name; expected a file"),
        ("base64:?", "here: memory: not base64; expected a file"),
        ("large.bin", "FOLDER/large.bin: too long; expected a memory of at most 4096 bytes"),
    ],
)
def test_what_cannot_be_a_memory_is_refused(memory: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "large.bin").write_bytes(bytes(4097))
    with pytest.raises(InputError, match=f"^{re.escape(said.replace('FOLDER', str(tmp_path)))}$"):
        embedded(memory, tmp_path, "here")


def test_a_memory_for_a_strategy_without_is_refused() -> None:
    said = "memory: given; expected none unless controller.strategy learns"
    with pytest.raises(InputError, match=said):
        load("lab_n_b", settings=['memory="base64:AAAA"'])
