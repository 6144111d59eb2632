"""Which way a firmware is plugged in: by the ending of its file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.user_file import resolved
from sil.files.extras import ROOT

if TYPE_CHECKING:
    from controller.config import FirmwareConfig
    from sil.coupling.transports.channel import Participant

SHIPPED_IN_C = ROOT / "controller" / "c" / "opc4.c"


def firmware_node(
    where: str, config: FirmwareConfig, name: str = "controller", folder: Path | None = None
) -> Participant:
    """Return the control unit with a firmware of the user: FILE.py[:CLASS], FILE.c, FILE.wasm, a checkout.

    One in C writes its cost and signals into `folder`. Raises InputError for a file that cannot be
    loaded, and ParticipantLost when its start fails.
    """
    if in_module(where):
        from sil.firmware.c_firmware import CController

        return CController(Path(where), config, name, folder)
    from sil.firmware.python_file import OwnController

    return OwnController(where, config, name)


def in_module(where: str) -> bool:
    """Return whether a firmware is in C or WebAssembly."""
    return Path(where).suffix in (".c", ".wasm")


def is_program(where: str) -> bool:
    """Return whether a name is that of a program, rather than of a file with settings."""
    return where == "c" or where.partition(":")[0].endswith((".py", ".c", ".wasm"))


def absolute(where: str, folder: Path) -> str:
    """Return `where` with its file's path taken from a folder."""
    if where == "c":
        return str(SHIPPED_IN_C)
    file, colon, name = where.partition(":")
    return f"{resolved(folder / file)}{colon}{name}"
