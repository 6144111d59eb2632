"""What is told of an error that the system raised."""

from __future__ import annotations

import errno
import os

from can_dbc.errors import told


def test_the_path_and_the_reason_without_python_s_words() -> None:
    full = os.strerror(errno.ENOSPC)
    assert told(OSError(errno.ENOSPC, full, "out/result.json")) == f"out/result.json: {full}"
    assert told(OSError(errno.ENOSPC, full)) == full
    assert told(OSError("no reply")) == "no reply"
