"""The errors that end a command with one clear line, and the words that their lines share."""

from __future__ import annotations

from collections.abc import Iterable


class InputError(ValueError):
    """An input is wrong; the one-line message names file, location and remedy.

    The command line prints the message and exits with code 2. A name from the input may hold line
    breaks or other control characters: the message shows them escaped.
    """

    def __str__(self) -> str:
        return escaped(super().__str__())


class CodecError(InputError):
    """A frame or message does not follow the contract in opc4.dbc."""


class RunError(RuntimeError):
    """A run could not be completed (a participant died or stalled, a bus failed).

    The command line prints the message and exits with code 3.
    """


def escaped(text: str) -> str:
    """Return the text with every character that cannot be printed as its escape sequence."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def os_error_text(error: OSError) -> str:
    """Return the reason of a system error, after the path if the error has one; of two the second one, a target."""
    why, file = error.strerror or str(error), error.filename2 or error.filename
    return f"{file}: {why}" if file else why


def nearest(name: str, names: Iterable[str], count: int = 3, cutoff: float = 0.6) -> list[str]:
    """Return up to `count` names that resemble `name` most, best first; `cutoff`: least similarity, 0 to 1."""
    from difflib import get_close_matches  # only needed on the way to an error

    return get_close_matches(name, list(names), count, cutoff)


def unknown_name(name: str, choices: Iterable[str]) -> str:
    """Return 'unknown; expected one of ...' with the nearest names first.

    Of more than ten names only the nearest are listed, followed by '...'; all if none is near.
    """
    names = list(choices)
    near = nearest(name, names)
    others = [other for other in names if other not in near]
    listed = [*near, "..."] if near and len(names) > 10 else near + others
    expected = f"one of {', '.join(listed)}" if names else "none"
    return f"unknown; expected {expected}"
