"""Independent pieces of work here, in forked processes or on a cluster, answers in order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from can_dbc.errors import InputError, RunError
from can_dbc.user_file import crash_places

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_WORK: list[Callable[[Any], Any]] = []


def _call(item: Any) -> Any:
    return _WORK[-1](item)


def in_turn(
    work: Callable[[Item], Answer],
    items: Sequence[Item],
    *,
    workers: int = 1,
    cluster: str | None = None,
    then: str = "",
) -> Iterator[Answer]:
    """Yield work(item) of every item, in order. Raises RunError, with what to do `then`, if a worker is lost."""
    if cluster is not None:
        yield from _on_cluster(work, items, cluster, then)
    elif workers > 1 and items:
        yield from in_processes(work, items, workers, then)
    else:
        yield from map(work, items)


def _on_cluster(
    work: Callable[[Item], Answer], items: Sequence[Item], address: str, then: str
) -> Iterator[Answer]:
    """Yield the answers of the workers of a dask.distributed scheduler."""
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
        for future in client.map(work, items, pure=False, retries=2):
            yield future.result()
            future.release()
    except (KilledWorker, FutureCancelledError, OSError) as error:
        raise RunError(
            "; ".join(filter(None, [f"--cluster {address}: lost: {error}", then]))
        ) from None
    finally:
        client.close()


def in_processes(
    work: Callable[[Item], Answer], items: Sequence[Item], workers: int, then: str = ""
) -> Iterator[Answer]:
    """Yield work(item) of every item from forked processes, in order; items and answers are pickled.

    Raises RunError if a process dies, with what to do `then`, and what the work raises.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(os.getpid(),))
    _WORK.append(work)
    try:
        yield from pool.map(_call, items)
        pool.shutdown()
    except BrokenProcessPool:
        places = [place for find in crash_places if (place := find())]
        raise RunError(
            "; ".join(filter(None, [" at ".join(["a worker process died", *places]), then]))
        ) from None
    finally:
        _WORK.remove(work)
        pool.shutdown(wait=False, cancel_futures=True)


def _begin(parent: int) -> None:
    """Leave interrupts to `parent`, and end when that was killed: its pipes stay open in other workers."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
