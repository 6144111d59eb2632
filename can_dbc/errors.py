"""The two errors that end a command with a clear line instead of a traceback."""


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
