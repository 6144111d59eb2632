"""Start a firmware of your own from a draft."""

from __future__ import annotations

import argparse

from sil.cli.draft import NEW, write_draft
from sil.cli.options import JSON, argument

EXAMPLE = "example: opc4 firmware --new own.py"
ARGUMENTS = (NEW, argument("--force", "replace FILE"), JSON)


def run(arguments: argparse.Namespace) -> int:
    """Write a draft. Raises InputError without an option that says what to do."""
    from can_dbc.errors import InputError

    if arguments.new is None:
        raise InputError("nothing to do; expected --new FILE.py")
    return write_draft("firmware", arguments, f"opc4 run lab_n_b --set firmware={arguments.new}")
