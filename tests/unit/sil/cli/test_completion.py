"""Completion scripts: bash takes them, and they know commands, options and scenarios."""

from __future__ import annotations

import subprocess

import pytest

from sil import cli


def completed(script: str, words: str) -> list[str]:
    program = f"{script}\nCOMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _opc4\n"
    program += 'echo "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_bash_completes_commands_options_and_scenarios(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert completed(script, "opc4 si") == ["simulate"]
    assert set(completed(script, "opc4 run --tr")) == {"--transport"}
    assert completed(script, "opc4 run full") == ["full_shift"]
    assert completed(script, "opc4 whatif sensor_del") == ["sensor_delay"]


def test_the_other_shells_and_a_wrong_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--completion", "zsh"]) == 0
    assert "bashcompinit" in capsys.readouterr().out
    assert cli.main(["--completion", "fish"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("__fish_seen_subcommand_from run' -l transport" in line for line in lines)
    assert cli.main(["--completion", "csh"]) == 2
    assert capsys.readouterr().err == "opc4 --completion: csh; expected one of bash, zsh, fish\n"
