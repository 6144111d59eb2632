"""Independent pieces of work on a dask.distributed cluster, answers in order.

Checked by: tests/unit/sil/studies/test_executor.py, tests/unit/sil/shift_diagnosis/test_watch.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from can_dbc.errors import InputError, RunError

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def on_cluster(
    work: Callable[[Item], Answer], items: Sequence[Item], address: str, then: str
) -> Iterator[Answer]:
    """Yield work(item) of every item from the workers of a scheduler, in the order of the items.

    The workers need this package; work, items and answers are pickled. then: what to do when the
    cluster is lost. Raises InputError without dask.distributed, RunError if the cluster is not there
    or is lost, and what the work raises.
    """
    try:
        from distributed import Client
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise InputError(
            "--cluster: dask.distributed is not installed; expected the extra 'cluster'"
        ) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise RunError(f"--cluster {address}: cannot be reached: {error}") from None
    try:
        if not client.scheduler_info()["workers"]:
            raise RunError(f"--cluster {address}: the scheduler has no workers; expected some")
        futures = client.map(work, items, pure=False, retries=2)
        for future in futures:
            yield future.result()
            future.release()
    except (KilledWorker, FutureCancelledError, OSError) as error:
        raise RunError(f"--cluster {address}: lost: {error}; {then}") from None
    finally:
        client.close()
