"""Columns of a group of CAN frames in an MF4 file to frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Final

from sil.logs.frame import DLC_LENGTHS, MAX_EXTENDED_ID, MAX_STANDARD_ID, MAX_TIME_NS, LogFrame
from sil.logs.mf4_blocks import LARGEST_RECORD, VARIABLE_LENGTH

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

NO_VALUE: Final = "its data is missing"
_TRUE_TEXTS: Final = ("tx", "true", "yes")

Guard = Callable[[], AbstractContextManager[None]]
"""Makes the context in which asammdf reads: it turns what asammdf raises into InputError."""


def stored_bytes(group: Any, index: int) -> int:
    """Return the bytes of a channel's values of variable length, their lengths included."""
    return sum(block.original_size for block in group.get_signal_data_blocks(index))


class Values:
    """Data of variable length: the values at the offsets that records give.

    asammdf's own extraction reads outside of its memory if an offset is damaged.
    """

    def __init__(self, mdf: Any, guard: Guard, group: Any, index: int | None) -> None:
        """mdf, guard: of the file; index: the channel of the data in the group, None if there is none."""
        self._mdf, self._guard, self._group, self._index = mdf, guard, group, index
        self.used = False
        if index is not None and group.channels[index].channel_type == VARIABLE_LENGTH:
            self.used = True
            group.channels[index].channel_type = 0  # the offsets, as plain numbers
            self._size = stored_bytes(group, index)

    def at(self, offsets: Sequence[int]) -> list[bytes | None]:
        """Return the values at offsets in bytes, None where there is no whole one."""
        inside = [offset for offset in offsets if 0 <= offset <= self._size - 4]
        if not inside:
            return [None] * len(offsets)
        first = min(inside)
        with self._guard():
            stored = self._mdf._mdf._load_signal_data(
                self._group, self._index, offsets=(first, max(inside))
            )
        found: list[bytes | None] = []
        for offset in offsets:
            begin = offset - first + 4
            length = int.from_bytes(stored[begin - 4 : begin], "little") if begin >= 4 else -1
            value = stored[begin : begin + length] if 0 <= length <= LARGEST_RECORD else b""
            found.append(value if len(value) == length else None)
        return found


def zero_rows(columns: dict[str, NDArray[Any]], times_s: NDArray[np.float64]) -> list[bool]:
    """Return of which rows nothing but zeros is there: they were in a block that is lost.

    columns: [n] or [n, bytes] by part of a frame; times_s: [n] in s from the start of the file.
    """
    import numpy as np

    empty = times_s == 0
    for column in columns.values():
        if column.dtype.kind in "iu":
            empty &= ~np.any(column.reshape(len(times_s), -1), axis=1)
    found: list[bool] = empty.tolist()
    return found


def frames_of(
    kind: str,
    columns: dict[str, NDArray[Any]],
    times_s: NDArray[np.float64],
    values: Values,
    start_ns: int,
) -> Iterator[tuple[LogFrame, str | None]]:
    """Yield frames, and what is wrong with each.

    columns: [n] or [n, bytes] by part of a frame; times_s: [n] in s from the start of the file.
    """
    import numpy as np

    count = len(times_s)
    error, remote = kind == "CAN_ErrorFrame", kind == "CAN_RemoteFrame"
    valid = np.abs(times_s) < MAX_TIME_NS / 1e9
    seconds = np.floor(np.where(valid, times_s, 0.0))
    parts_ns = np.rint((np.where(valid, times_s, 0.0) - seconds) * 1e9)
    times_ns = seconds.astype(np.int64) * 10**9 + parts_ns.astype(np.int64)
    flags = {name: numbers(columns.get(name), count) != 0 for name in ("EDL", "BRS", "ESI", "Dir")}
    code, word = numbers(columns.get("DLC"), count) & 15, numbers(columns.get("ID"), count)
    fd, can_id = flags["EDL"], word & MAX_EXTENDED_ID
    extended = (word >> 31 != 0) | (can_id > MAX_STANDARD_ID)
    if "IDE" in columns:
        extended = numbers(columns["IDE"], count) != 0
    length = np.where(fd, np.array(DLC_LENGTHS)[code], np.minimum(code, 8))
    if "DataLength" in columns:
        length = np.maximum(numbers(columns["DataLength"], count), 0)
    if remote:
        length = np.zeros(count, np.int64)
    raw_dlc = np.where(remote | (~fd & (code > 8) & (length == 8)), code, 0)
    data = _data(None if remote else columns.get("DataBytes"), count, values)
    channel = [""] * count
    if "BusChannel" in columns:
        channel = list(map(str, numbers(columns["BusChannel"], count).tolist()))
    way = np.where(flags["Dir"], "Tx", "Rx" if "Dir" in columns else "").tolist()
    arrays = (times_ns, can_id, extended, fd, flags["BRS"], flags["ESI"], raw_dlc, length, valid)
    for time_ns, number, long, is_fd, brs, esi, raw, wanted, timed, content, name, direction in zip(
        *(array.tolist() for array in arrays), data, channel, way, strict=True
    ):
        problem = None if timed else "a time that is no number"
        if content is None:
            problem, content = problem or NO_VALUE, b""
        elif len(content) < wanted and not error:
            problem = problem or f"{len(content)} bytes of data; expected {wanted}"
        flags_and_names = long, remote, error, is_fd, brs, esi, name, direction, raw
        yield LogFrame(start_ns + time_ns, number, content[:wanted], *flags_and_names), problem


def numbers(column: NDArray[Any] | None, count: int) -> NDArray[np.int64]:
    """Return a column [n] as whole numbers, zeros if there is none."""
    import numpy as np

    if column is None:
        return np.zeros(count, np.int64)
    if column.dtype.kind in "SUO":
        words = [w.decode("latin-1") if isinstance(w, bytes) else str(w) for w in column.tolist()]
        return np.array([word.strip("\x00 ").lower() in _TRUE_TEXTS for word in words], np.int64)
    if column.dtype.kind == "f":
        column = np.where(np.abs(column) < 2.0**62, column, -1.0)  # also what is not a number
    return column.astype(np.int64)


def _data(column: NDArray[Any] | None, count: int, values: Values) -> Sequence[bytes | None]:
    """Return the data bytes of each row."""
    import numpy as np

    if column is not None and values.used:
        return values.at(column.tolist())
    if column is None or column.ndim != 2:
        return [b""] * count
    width, content = column.shape[1], np.ascontiguousarray(column).tobytes()
    return [content[i : i + width] for i in range(0, count * width, width)]
