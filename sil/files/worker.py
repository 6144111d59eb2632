"""The beginning of every worker process of a pool.

Checked by: tests/unit/sil/diagnosis/test_workers.py, tests/faults/test_crash_safety.py
"""

from __future__ import annotations

import os
import signal
import threading
import time


def begin_worker(parent: int) -> None:
    """Leave interrupts to the process `parent`, and end when that is gone.

    A worker whose parent was killed would wait for ever otherwise: its pipes stay open in the others.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
