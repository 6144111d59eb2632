"""The errors that end a command with one clear line, and the words that their lines share."""

from __future__ import annotations

from collections.abc import Iterable


class InputError(ValueError):
    """An input is wrong; the one-line message names file, location and remedy.

    The command line prints the message and exits with code 2.
    """


class CodecError(InputError):
    """A frame or message does not follow the contract in opc4.dbc."""


class RunError(RuntimeError):
    """A run could not be completed (a participant died or stalled, a bus failed).

    The command line prints the message and exits with code 3.
    """


def os_error_text(error: OSError) -> str:
    """Return the reason of a system error, after the path if the error has one."""
    why = error.strerror or str(error)
    return f"{error.filename}: {why}" if error.filename else why


def nearest(name: str, known: Iterable[str], count: int = 3, cutoff: float = 0.6) -> list[str]:
    """Return up to `count` of the known names that resemble `name` most, best first.

    `cutoff`: similarity from 0 to 1 below which a name is left out.
    """
    from difflib import get_close_matches  # only needed on the way to an error

    return get_close_matches(name, list(known), count, cutoff)


def unknown_name(name: str, known: Iterable[str]) -> str:
    """Return 'unknown; expected one of ...' with the nearest names, or all if none is near."""
    names = list(known)
    expected = f"one of {', '.join(nearest(name, names) or names)}" if names else "none"
    return f"unknown; expected {expected}"
