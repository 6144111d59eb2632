"""MF4 bus logs, written through asammdf in batches of many frames."""

from __future__ import annotations

from typing import Any, Final

from can_dbc.errors import InputError
from sil.logs.backend import LogWriter
from sil.logs.frame import LogFrame
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS

_EXACT_SPAN_NS: Final = 4_000_000 * 10**9
"""Times are stored as seconds in a double; up to here (46 days) these are exact to the ns."""

_SOURCE_BUS, _BUS_CAN = 2, 2
_COMPRESSION_DEFLATE: Final = 1
TOOL: Final = "opc4-sil"


def import_asammdf(path: str) -> Any:
    """asammdf, which is optional and slow to import.

    Raises: InputError naming the extra when it is not installed.
    """
    try:
        import asammdf
    except ImportError:
        raise InputError(
            f"{path}: writing MF4 needs asammdf; expected it installed (pip install opc4-sil[mdf])"
        ) from None
    return asammdf


def new_measurement(path: str, start_ns: int) -> Any:
    """An empty MDF 4.10 measurement that starts at `start_ns` (0 for relative times), no wall time.

    Raises: InputError when asammdf is not installed.
    """
    asammdf = import_asammdf(path)
    from asammdf.blocks.v4_blocks import FileHistory

    measurement = asammdf.MDF(version="4.10")
    measurement.header.abs_time = start_ns
    measurement.header.tz_offset = 0
    measurement.header.daylight_save_time = 0
    measurement.header.time_flags = 0
    history = FileHistory()
    history.abs_time = start_ns
    history.tz_offset = 0
    history.daylight_save_time = 0
    history.time_flags = 0
    history.comment = (
        f"<FHcomment><TX>written</TX><tool_id>{TOOL}</tool_id><tool_vendor>{TOOL}</tool_vendor>"
        "<tool_version>1</tool_version></FHcomment>"
    )
    measurement.file_history.append(history)
    return measurement


class Mf4Writer(LogWriter):
    """Writes groups of data, CAN FD, error and remote frames in the ASAM bus logging layout."""

    format = "mf4"
    patched = True
    batch = 1 << 14

    def __init__(self, path: str) -> None:
        import_asammdf(path)
        super().__init__(path)
        self._measurement: Any = None
        self._origin_ns = 0
        self._groups: dict[str, int] = {}

    def _begin(self, frames: list[LogFrame]) -> None:
        first_ns = min((frame.time_ns for frame in frames), default=0)
        if first_ns >= RELATIVE_BELOW_NS:
            self._origin_ns = first_ns // NS_PER_MS * NS_PER_MS
        self._measurement = new_measurement(self.path, self._origin_ns)

    def _write_batch(self, frames: list[LogFrame]) -> None:
        if self._measurement is None:
            self._begin(frames)
        kinds: dict[str, list[LogFrame]] = {}
        for frame in frames:
            kinds.setdefault(_kind(frame), []).append(frame)
        for kind, share in kinds.items():
            self._extend(kind, share)

    def _extend(self, kind: str, frames: list[LogFrame]) -> None:
        """Append frames of one kind to their group, which the first of them makes."""
        import numpy as np

        name, data_bytes = _LAYOUT[kind]
        rows = np.zeros(len(frames), dtype=_columns(name, data_bytes))
        rows[f"{name}.BusChannel"] = [self.channel_number(f.channel, 0) for f in frames]
        rows[f"{name}.ID"] = [frame.can_id for frame in frames]
        rows[f"{name}.IDE"] = [frame.extended for frame in frames]
        rows[f"{name}.DLC"] = [frame.dlc for frame in frames]
        rows[f"{name}.Dir"] = [frame.direction == "Tx" for frame in frames]
        rows[f"{name}.EDL"] = [frame.fd for frame in frames]
        rows[f"{name}.BRS"] = [frame.brs for frame in frames]
        rows[f"{name}.ESI"] = [frame.esi for frame in frames]
        if data_bytes:
            padded = b"".join([frame.data.ljust(data_bytes, b"\x00") for frame in frames])
            rows[f"{name}.DataBytes"] = np.frombuffer(padded, np.uint8).reshape(-1, data_bytes)
            rows[f"{name}.DataLength"] = [len(frame.data) for frame in frames]
        self._count_losses(frames)
        times_ns = np.array([frame.time_ns - self._origin_ns for frame in frames], dtype=np.int64)
        # Integer seconds and the rest apart: one rounding, to the double nearest to the decimal.
        seconds = times_ns // 10**9 + (times_ns % 10**9) / 1e9
        group = self._groups.get(kind)
        if group is None:
            self._groups[kind] = len(self._groups)
            self._append(name, rows, seconds)
        else:
            self._measurement.extend(group, [(seconds, None), (rows, None)])

    def _append(self, name: str, rows: Any, seconds: Any) -> None:
        from asammdf import Signal
        from asammdf.blocks.source_utils import Source

        source = Source("CAN", "CAN", "", _SOURCE_BUS, _BUS_CAN)
        signal = Signal(name=name, samples=rows, timestamps=seconds, source=source)
        self._measurement.append(signal, acq_name=name, acq_source=source)

    def _count_losses(self, frames: list[LogFrame]) -> None:
        for frame in frames:
            if not frame.direction:
                self.losses["direction not recorded, written as Rx"] += 1
            if abs(frame.time_ns - self._origin_ns) > _EXACT_SPAN_NS:
                self.losses["times more than 46 days from the start, rounded"] += 1
            if frame.error and frame.remote:
                self.losses["remote flag of an error frame"] += 1

    def _finish(self) -> None:
        import numpy as np

        if self._measurement is None:
            self._begin([])
        if not self._groups:
            rows = np.zeros(0, dtype=_columns(*_LAYOUT["classic"]))
            self._append("CAN_DataFrame", rows, np.zeros(0))
        try:
            self._measurement.save(
                self._file, compression=_COMPRESSION_DEFLATE, add_history_block=False
            )
        finally:
            self._measurement.close()

    def abort(self) -> None:
        """Throw away what was written."""
        if self._measurement is not None:
            self._measurement.close()
        super().abort()


_LAYOUT: Final = {
    "classic": ("CAN_DataFrame", 8),
    "fd": ("CAN_DataFrame", 64),
    "error": ("CAN_ErrorFrame", 64),
    "remote": ("CAN_RemoteFrame", 0),
}


def _kind(frame: LogFrame) -> str:
    if frame.error:
        return "error"
    if frame.remote:
        return "remote"
    return "fd" if frame.fd else "classic"


def _columns(name: str, data_bytes: int) -> Any:
    import numpy as np

    fields: list[Any] = [
        (f"{name}.BusChannel", "<u1"),
        (f"{name}.ID", "<u4"),
        (f"{name}.IDE", "<u1"),
        (f"{name}.DLC", "<u1"),
        (f"{name}.Dir", "<u1"),
        (f"{name}.EDL", "<u1"),
        (f"{name}.BRS", "<u1"),
        (f"{name}.ESI", "<u1"),
    ]
    if data_bytes:
        fields += [(f"{name}.DataLength", "<u1"), (f"{name}.DataBytes", "<u1", (data_bytes,))]
    return np.dtype(fields)
