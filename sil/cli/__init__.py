"""The command `opc4`: a table of commands, each a module that is imported on use."""

from __future__ import annotations

import argparse
import codecs
import errno
import gc
import importlib
import io
import json
import os
import re
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any, NoReturn

from can_dbc.errors import InputError, RunError, nearest, os_error_text

PASSED, FAILED, BAD_INPUT, NOT_FINISHED = 0, 1, 2, 3

_STDOUT = "standard output"
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_interrupts: list[int] = []  # signals that arrived: a library may make an error of its own of one
_interrupted_at: list[str] = []  # FILE:LINE of a user's Python that was running then

COMMANDS = {
    "run": "run one scenario: plant and controller over CAN",
    "compare": "compare runs: metrics, traces over each other, events that differ",
    "simulate": "simulate the plant alone, under the conditions of a measurement campaign",
    "calibrate": "fit a model to healthy measurements of one unit: the baseline of its diagnoses",
    "diagnose": "compare measurements with the simulation and name the cause of a difference",
    "replay": "feed a recorded log into the firmware and compare; shifts of a truck's log",
    "whatif": "run a study: sweep any values of model, firmware, sensor and bus",
    "identify": "identify flow maps, friction, exponents or oil damper from a campaign",
    "firmware": "draft or check a firmware of your own",
    "swarm": "draw scenarios, check the rules, hand over the shortest that breaks one",
    "fmu": "export plant or firmware as a co-simulation unit for other tools",
    "convert": "convert logs between candump, ASC, BLF, TRC, MF4 and CSV",
    "example": "list the shipped examples, or copy one to start from",
    "live": "open a live bench in the browser, on this machine only",
    "node": "run one participant of a scenario alone, on a bus",
    "bus": "show transports found here, load and worst-case response times of a bus",
}
"""Command name to one line of help; the command itself is the module of that name in this package,
with an example at the end of its docstring, a table `ARGUMENTS` and `run(arguments) -> exit code`."""

_HELP = """\
usage: opc4 COMMAND ...

Software-in-the-loop simulator of the Opticruise gear shift.

commands:
{commands}

exit codes: 0 done and passed, 1 an expectation failed or a difference was found,
            2 bad input or usage, 3 a participant died or the run could not finish,
            130 interrupted by Ctrl-C, 143 ended by SIGTERM

opc4 COMMAND --help describes a command, with an example; opc4 --version prints the version.
"""


class _UsageError(Exception):
    """What is wrong with the arguments, in one line."""


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        for kind, expected in (("int", "a whole number"), ("float", "a number")):
            message = re.sub(f"invalid {kind} value: (.*)", rf"\1; expected {expected}", message)
        message = re.sub(r"invalid choice: (.*) \(choose from (.*)\)", r"\1; expected \2", message)
        raise _UsageError(f"{_shortened(message)}; see {self.prog} --help")


def _shortened(message: str) -> str:
    """Return one line of at most 1,000 characters; what the user gave at length is cut in its middle."""
    message = " ".join(message.split("\n"))
    return message if len(message) <= 1000 else f"{message[:500]} ... {message[-500:]}"


def _handle_signals(handler: Any) -> None:
    """Set what the ending signals do; one that is ignored, as SIGHUP under nohup, stays ignored."""
    for number in ENDING_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    _interrupts.append(number)
    if (watched := sys.modules.get("sil.cli.watched")) is not None:
        _interrupted_at.extend(watched.places(frame))
    raise KeyboardInterrupt(number)


def _unraisable(what: Any) -> None:
    """End the command if an interrupt came in a callback of the interpreter, where it would be lost."""
    if isinstance(what.exc_value, KeyboardInterrupt):
        os.write(2, b"opc4: interrupted\n")
        os._exit(_interrupted_code())  # what it has begun is marked INCOMPLETE
    sys.__unraisablehook__(what)


class _Output(io.FileIO):
    """Standard output, whose errors name it."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, _STDOUT) from None


def command() -> NoReturn:
    """Be the process `opc4`, which SIGTERM and SIGHUP end as Ctrl-C does; closed streams are null."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # the matrices are small: threads only wait for each other
    gc.set_threshold(50_000, 10, 10)  # what is imported stays: looking there is a tenth of a run
    _handle_signals(_interrupt)
    sys.unraisablehook = _unraisable
    os.register_at_fork(after_in_child=lambda: _handle_signals(signal.SIG_DFL))
    for descriptor in (0, 1, 2):  # else a file of ours could become standard output
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    codecs.register_error("json", _escaped)
    encoding = sys.stdout.encoding if sys.stdout else "utf-8"
    output = io.BufferedWriter(_Output(1, "w", closefd=False))
    sys.stdout = io.TextIOWrapper(output, encoding, "json", line_buffering=os.isatty(1))
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    code = main(watched=True)
    _handle_signals(signal.SIG_DFL)
    try:
        sys.stdout.flush()
    except OSError as error:
        code = _unwritable(error)
    sys.exit(code)


def _escaped(error: UnicodeError) -> tuple[str, int]:
    """Return what a stream cannot encode as JSON escapes it: the output stays valid JSON."""
    assert isinstance(error, UnicodeEncodeError)
    return json.dumps(error.object[error.start : error.end])[1:-1], error.end


def main(argv: Sequence[str] | None = None, watched: bool = False) -> int:
    """Run one `opc4` command and return its exit code.

    watched: a forked process goes on before a user's Python runs. Bad input ends in one line on standard
    error; with --json it is also the `error` of the one object on standard output. Checked by test_cli.
    """
    try:
        return _main(list(sys.argv[1:] if argv is None else argv), watched)
    except (KeyboardInterrupt, Exception) as error:  # while a command was being loaded
        if _interrupts or isinstance(error, KeyboardInterrupt):
            print("opc4: interrupted", file=sys.stderr)
            return _interrupted_code()
        if isinstance(error, OSError):  # of standard output: all others are reported by _guarded
            return _unwritable(error)
        raise


def _interrupted_code() -> int:
    """Return 128 and the number of the signal, as shells do."""
    return 128 + (_interrupts[0] if _interrupts else signal.SIGINT)


def _unwritable(error: OSError) -> int:
    """Report that standard output cannot be written; what it still holds is dropped."""
    if not isinstance(error, BrokenPipeError):  # else the reader is gone: nobody to report it to
        print(f"opc4: {_STDOUT}: {error.strerror}", file=sys.stderr)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    return NOT_FINISHED


def _main(arguments: list[str], watched: bool) -> int:
    if any("\0" in word for word in arguments):  # no system has such files
        return _refuse("opc4", "a null byte in an argument; expected none", arguments)
    if "" in arguments:  # as of an unset variable of a shell; Path("") would be the current folder
        return _refuse("opc4", "an empty argument; expected none", arguments)
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
        listed = ", ".join([*near, "..."] if (near := nearest(name, COMMANDS)) else COMMANDS)
        refused = f"no command {_shortened(repr(name))}; expected one of {listed}"
        return _refuse("opc4", refused, arguments)
    try:
        command: Any = importlib.import_module(f"sil.cli.{name}")
    except ModuleNotFoundError as error:
        print(f"opc4 {name}: the library {error.name!r} is not installed", file=sys.stderr)
        return NOT_FINISHED

    try:
        parsed = parser(name, command).parse_args(arguments[1:])
    except (_UsageError, InputError) as error:
        return _refuse(f"opc4 {name}", str(error), arguments)
    except SystemExit:  # --help
        return PASSED
    if watched:
        from can_dbc.user_file import before_running

        before_running.append(_watch)
    if parsed.quiet:
        from sil.files import progress

        progress.silence()
    return _guarded(name, command, parsed)


def _watch(file: str) -> None:
    from sil.cli.watched import go_on_in_child

    go_on_in_child(file)


def _refuse(program: str, why: str, arguments: Sequence[str]) -> int:
    """Report arguments that no command takes; return the exit code."""
    print(f"{program}: {why}", file=sys.stderr)
    if "--json" in arguments:
        print(json.dumps({"error": why, "exit_code": BAD_INPUT}))
    return BAD_INPUT


def parser(name: str, command: Any) -> argparse.ArgumentParser:
    """Return the argument parser of a command, given its module."""
    from sil.cli.options import argument

    description, heading, example = command.__doc__.partition("example:")
    options = _Parser(
        prog=f"opc4 {name}",
        description=description,
        epilog=heading + example,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    for name, how in (*command.ARGUMENTS, argument("--quiet", "no progress on standard error")):
        options.add_argument(name, **how)
    return options


def _guarded(name: str, command: Any, parsed: argparse.Namespace) -> int:
    """Run the command; report what a user can cause in one line and an exit code."""
    try:
        code: int = command.run(parsed)
        sys.stdout.flush()
        for note in _settle(None if code in (PASSED, FAILED) else "not finished"):
            print(f"opc4 {name}: {note}", file=sys.stderr)
        return code
    except InputError as error:
        message, code = str(error), BAD_INPUT
    except RunError as error:
        message, code = str(error), NOT_FINISHED
    except KeyboardInterrupt:
        message, code = "interrupted", _interrupted_code()
    except MemoryError:
        message, code = "not enough memory", NOT_FINISHED
    except OSError as error:  # a full disk, for example
        if error.filename == _STDOUT:
            _settle("not finished")
            return _unwritable(error)
        message, code = os_error_text(error), NOT_FINISHED
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            message, code = f"{message}; expected a path that can exist", BAD_INPUT
        elif error.errno in (errno.EACCES, errno.EROFS):
            message, code = f"{message}; expected a path with permission", BAD_INPUT
    except ModuleNotFoundError as error:
        message, code = f"the library {error.name!r} is not installed", NOT_FINISHED
    except Exception as error:
        if not _interrupts:  # else a library may have made it of one
            raise
        message, code = str(error), NOT_FINISHED
    if _interrupts:
        message, code = " at ".join(["interrupted", *_interrupted_at[:1]]), _interrupted_code()
    message = _shortened(message)
    notes = _settle(f"opc4 {name}: {message}")
    print(f"opc4 {name}: {'; '.join([message, *notes])}", file=sys.stderr)
    if getattr(parsed, "json", False):
        print(json.dumps({"error": message, "exit_code": code}))
    return code


def _settle(why: str | None) -> list[str]:
    """Mark what the command has written as complete, or with the reason why it is not; return notes."""
    results = sys.modules.get("sil.files.output_folder")  # not loaded: nothing was begun
    if results is None:
        return []

    try:
        notes: list[str] = results.close_folders(why)
    except OSError as error:
        return [os_error_text(error)]
    return notes
