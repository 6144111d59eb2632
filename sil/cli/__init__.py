"""The command `opc4`: a table of commands, each in a file of its own, imported when asked for."""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

PASSED, FAILED, BAD_INPUT, NOT_FINISHED = 0, 1, 2, 3

LONGEST_COMPLAINT = 1000

COMMANDS = {
    "run": "run one scenario: plant and controller over CAN",
    "simulate": "the plant alone, under the conditions of a measurement campaign",
    "diagnose": "measured against simulated: what is wrong, why, what it gains to know",
    "replay": "recorded inputs into the firmware alone; shifts of any truck's log",
    "whatif": "a sweep over any values of model, firmware, sensor and bus",
    "identify": "flow maps, friction, exponents or oil damper from a campaign",
    "claims": "the thesis's claims: claimed, achieved, met or not",
    "fmu": "plant or firmware as a co-simulation unit for other tools",
    "convert": "convert logs between candump, ASC, BLF, TRC, MF4 and CSV",
    "node": "run one participant of a scenario alone, on a bus",
    "bus": "transports found here; load and worst-case response times",
}
"""Command name to one line of help; the command itself is the module of that name in this package,
with `add_arguments(parser)` and `run(arguments) -> exit code`."""

_HELP = """\
usage: opc4 COMMAND ...

Software-in-the-loop simulator of the Opticruise gear shift.

commands:
{commands}

exit codes: 0 done and passed, 1 an expectation failed or a difference was found,
            2 bad input or usage, 3 a participant died or the run could not finish

opc4 COMMAND --help tells more, with an example; opc4 --version prints the version.
"""


class _Parser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {_shortened(message)}; see {self.prog} --help\n")


def _shortened(message: str) -> str:
    """One line, and what the user gave us at great length cut in its middle."""
    message = " ".join(message.split("\n"))
    if len(message) <= LONGEST_COMPLAINT:
        return message
    half = LONGEST_COMPLAINT // 2
    return f"{message[:half]} ... {message[-half:]}"


_ENDING_SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def command() -> NoReturn:
    """Be the process `opc4`: SIGTERM and SIGHUP end a command as Ctrl-C does.

    A signal that is ignored, as SIGHUP under nohup, stays ignored.
    """
    for number in _ENDING_SIGNALS:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    os.register_at_fork(after_in_child=_end_at_once)
    code = main()
    _ignore_interrupts()
    sys.exit(code)


def _end_at_once() -> None:
    """Let the ending signals end a worker process without a traceback."""
    for number in _ENDING_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one `opc4` command and return its exit code (0, 1, 2 or 3).

    Bad input and usage end in one line on standard error; with --json the same line is also the
    `error` of the one object on standard output.  Checked by test_cli.
    """
    try:
        return _main(list(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt:  # while a command was being loaded
        pass
    except RuntimeError as error:  # what Python 3.11 makes of an interrupt while a class is made
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
    _ignore_interrupts()
    print("opc4: interrupted", file=sys.stderr)
    return NOT_FINISHED


def _ignore_interrupts() -> None:
    """Ignore interrupts, since what is left takes no time."""
    for number in (signal.SIGINT, *_ENDING_SIGNALS):
        signal.signal(number, signal.SIG_IGN)
    # Python notes an interrupt that passed through exec (a dataclass being made), and would end with
    # the signal instead of our exit code; it forgets that when exec runs again.
    exec("")


def _main(arguments: list[str]) -> int:
    if any("\0" in word for word in arguments):  # no system has such files
        print("opc4: a null byte in an argument; expected none", file=sys.stderr)
        return BAD_INPUT
    if not arguments or arguments[0] in ("-h", "--help"):
        rows = "\n".join(f"  {name:<10} {summary}" for name, summary in COMMANDS.items())
        print(_HELP.format(commands=rows), end="")
        return PASSED if arguments else BAD_INPUT
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"opc4-sil {version('opc4-sil')}")
        return PASSED
    name = arguments[0]
    if name not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(name, COMMANDS, n=3) or list(COMMANDS)
        print(
            f"opc4: no command {_shortened(repr(name))}; nearest: {', '.join(near)}",
            file=sys.stderr,
        )
        return BAD_INPUT
    try:
        command: Any = importlib.import_module(f"sil.cli.{name}")
    except ModuleNotFoundError as error:
        print(f"opc4 {name}: the library {error.name!r} is not installed", file=sys.stderr)
        return NOT_FINISHED
    parser = _Parser(
        prog=f"opc4 {name}",
        description=command.__doc__,
        epilog=command.EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    command.add_arguments(parser)
    try:
        parsed = parser.parse_args(arguments[1:])
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else BAD_INPUT
    return _guarded(name, command, parsed)


def _guarded(name: str, command: Any, parsed: argparse.Namespace) -> int:
    """Run the command; turn what a user can cause into one line and an exit code."""
    from can_dbc.errors import InputError, RunError, os_error_text

    try:
        code: int = command.run(parsed)
        sys.stdout.flush()
        _settle(name, None if code in (PASSED, FAILED) else "not finished")
        return code
    except InputError as error:
        message, code = str(error), BAD_INPUT
    except RunError as error:
        message, code = str(error), NOT_FINISHED
    except KeyboardInterrupt:
        _ignore_interrupts()
        message, code = "interrupted", NOT_FINISHED
    except MemoryError:
        message, code = "not enough memory", NOT_FINISHED
    except BrokenPipeError:  # the reader of our output went away: nobody to tell
        sys.stderr.close()
        return NOT_FINISHED
    except OSError as error:  # disk full, no permission
        message, code = os_error_text(error), NOT_FINISHED
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            message, code = f"{message}; expected a path that can exist", BAD_INPUT
    except ModuleNotFoundError as error:
        message, code = f"the library {error.name!r} is not installed", NOT_FINISHED
    message = _shortened(message)
    print(f"opc4 {name}: {message}", file=sys.stderr)
    _settle(name, f"opc4 {name}: {message}")
    if getattr(parsed, "json", False):
        print(json.dumps({"error": message, "exit_code": code}))
    return code


def _settle(name: str, why: str | None) -> None:
    """End what the command has begun to write: complete, or why not."""
    results = sys.modules.get("sil.files.output_folder")  # not loaded: nothing was begun
    if results is None:
        return
    from can_dbc.errors import os_error_text

    try:
        for line in results.close_folders(why):
            print(f"opc4 {name}: {line}", file=sys.stderr)
    except OSError as error:
        print(f"opc4 {name}: {os_error_text(error)}", file=sys.stderr)
