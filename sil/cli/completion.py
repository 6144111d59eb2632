"""Shell completion: a script that completes commands, options and shipped names.

Written from the argument parsers themselves; `opc4 --help` never loads it.
Checked by: tests/unit/sil/cli/test_completion.py
"""

from __future__ import annotations

import importlib
import sys

from sil.cli import BAD_INPUT, COMMANDS, PASSED, parser

_BASH = """\
_opc4() {{
    local words="{commands} --help --version --completion"
    if [ "$COMP_CWORD" -gt 1 ]; then
        words=""
        case "${{COMP_WORDS[1]}}" in
{cases}
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _opc4 opc4
"""
_ZSH = "autoload -U +X bashcompinit && bashcompinit\n" + _BASH
SHELLS = ("bash", "zsh", "fish")


def print_completion(shells: list[str]) -> int:
    """Print the completion script of the one shell named; return the exit code."""
    if len(shells) != 1 or shells[0] not in SHELLS:
        given = " ".join(shells) or "no shell"
        print(f"opc4 --completion: {given}; expected one of {', '.join(SHELLS)}", file=sys.stderr)
        return BAD_INPUT
    if shells[0] == "fish":
        print("complete -c opc4 -n __fish_use_subcommand -l help -l version -l completion")
        for name, summary in COMMANDS.items():
            print(f"complete -c opc4 -n __fish_use_subcommand -a {name} -d {_quoted(summary)}")
            inside = f"complete -c opc4 -n '__fish_seen_subcommand_from {name}'"
            for option, text in _options(name).items():
                print(f"{inside} -l {option.removeprefix('--')} -d {_quoted(text)}")
            if names := _names(name):
                print(f"{inside} -a {_quoted(' '.join(names))}")
        return PASSED
    cases = "\n".join(
        f'        {name}) words="{" ".join([*_options(name), *_names(name)])}" ;;'
        for name in COMMANDS
    )
    script = _ZSH if shells[0] == "zsh" else _BASH
    print(script.format(commands=" ".join(COMMANDS), cases=cases), end="")
    return PASSED


def _options(name: str) -> dict[str, str]:
    """Return the long options of a command with their help."""
    actions = parser(name, importlib.import_module(f"sil.cli.{name}"))._actions
    return {
        option: (action.help or "").replace("%%", "%")
        for action in actions
        for option in action.option_strings
        if option.startswith("--")
    }


def _names(name: str) -> list[str]:
    """Return the shipped scenarios or studies that a command takes."""
    if name == "run":
        from sil.simulation import load_scenario

        return list(load_scenario.shipped())
    if name == "whatif":
        from sil.studies import load_study

        return list(load_study.shipped())
    return []


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
