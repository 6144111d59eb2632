"""The two errors that end a command with a clear line instead of a traceback, and what others tell."""


class InputError(ValueError):
    """Something given by the user is wrong; the one-line message names file, place and remedy.

    The command line prints the message and exits with code 2.
    """


class CodecError(InputError):
    """A frame or message does not follow the contract in opc4.dbc."""


class RunError(RuntimeError):
    """A run could not be completed (a participant died or stalled, a bus failed).

    The command line prints the message and exits with code 3.
    """


def told(error: OSError) -> str:
    """The line about what the system refused: the path, where there is one, and why.

    Checked by: tests/unit/can_dbc/test_errors.py
    """
    why = error.strerror or str(error)
    return f"{error.filename}: {why}" if error.filename else why
