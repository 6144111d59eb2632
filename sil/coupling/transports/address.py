"""The sockets of the local bus: one folder per user, one socket per channel."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import socket
import stat
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from can_dbc.errors import InputError, RunError
from sil.coupling.transports.channel import silent


def folder() -> Path:
    """Return `$XDG_RUNTIME_DIR/opc4`, or `opc4-UID` in the folder for temporary files, made if missing.

    Raises RunError when it belongs to somebody else or is open to others.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(runtime, "opc4") if runtime else Path(tempfile.gettempdir(), f"opc4-{os.getuid()}")
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        status = path.lstat()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected a folder for sockets") from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise RunError(f"{path}: expected a folder of this user that nobody else may enter")
    return path


def socket_path(channel: str) -> Path:
    """Return the socket of a channel: a name (letters, digits, `_.-`), or a path with a slash.

    Raises InputError for another text, a path too long for a socket, or a folder that is missing.
    """
    if "/" in channel:
        path = Path(channel)
    elif re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", channel):
        path = folder() / f"{channel}.sock"
    else:
        expected = "expected a name of letters, digits, '_', '.', '-', or a path"
        raise InputError(f"channel {channel!r}: {expected}")
    if len(os.fsencode(path)) > 107:  # sun_path holds 108 bytes, the last one zero
        raise InputError(f"channel {channel!r}: {path}; expected at most 107 bytes")
    if not path.parent.is_dir():
        raise InputError(f"channel {channel!r}: no folder {path.parent}; expected an existing one")
    return path


def running_channels() -> list[str]:
    """Return the names of the channels on which a hub listens, sorted."""
    return sorted(path.stem for path in folder().glob("*.sock") if _listened_to(path))


def listen(channel: str) -> tuple[socket.socket, Path]:
    """Open a channel's listening socket, in place of one that a killed hub left. Raises RunError when in use."""
    path = socket_path(channel)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    lock = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # two hubs that start at once must not both unlink
        if _listened_to(path):
            raise RunError(f"channel {channel!r}: another run uses it ({path})")
        if path.is_socket():
            path.unlink()
        listener.bind(str(path))
        path.chmod(0o600)
        listener.listen(64)
        listener.setblocking(False)
    except (OSError, RunError) as error:
        listener.close()
        if isinstance(error, RunError):
            raise
        raise RunError(f"channel {channel!r}: {path}: {error.strerror}") from None
    finally:
        os.close(lock)
    return listener, path


def connect(
    channel: str, wait_s: float = 0.0, say: Callable[[str], None] = silent
) -> socket.socket:
    """Return a connection to the hub of a channel; `say` takes the message that it is waited for.

    Raises InputError for a channel that cannot exist, RunError when no hub comes in time.
    """
    path = socket_path(channel)
    if path.exists() and not path.is_socket():
        raise InputError(f"channel {channel!r}: is no socket; expected that of a run")
    deadline = time.monotonic() + wait_s
    while True:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.connect(str(path))
            return connection
        except (FileNotFoundError, ConnectionRefusedError):
            connection.close()
        except OSError as error:
            connection.close()
            raise RunError(f"{path}: {error.strerror}") from None
        if time.monotonic() >= deadline:
            raise RunError(f"no run on local:{channel} within {wait_s:g} s")
        others = ", ".join(f"local:{name}" for name in running_channels())
        running = f"; runs found: {others}" if others else ""
        say(f"waiting up to {wait_s:g} s for a run on local:{channel}{running}")
        say = silent
        time.sleep(0.02)


def _listened_to(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        return probe.connect_ex(str(path)) in (0, errno.EAGAIN)  # EAGAIN: too busy to accept
