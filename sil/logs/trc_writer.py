"""PEAK TRC logs of version 2.1, written with every kind of frame that the format has."""

from __future__ import annotations

from typing import Final

from sil.logs.frame import LogFrame
from sil.logs.relative_text import RelativeWriter
from sil.logs.times import NS_PER_MS, NS_PER_S, utc_calendar

DAY_NS: Final = 86_400 * NS_PER_S
EPOCH_DAYS: Final = 25_569
"""Days from 1899-12-30, where PEAK's times begin, to 1970-01-01."""


class TrcWriter(RelativeWriter):
    """Writes version 2.1, times in milliseconds with three decimals as PEAK's own tools."""

    format = "trc"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._number = 0

    def _header(self, frames: list[LogFrame]) -> str:
        days, part_ns = divmod(self._origin_ns, DAY_NS)
        fraction = (part_ns * 10**15 + DAY_NS // 2) // DAY_NS
        moment = utc_calendar(self._origin_ns)
        milliseconds = self._origin_ns // NS_PER_MS % 1000
        return (
            ";$FILEVERSION=2.1\n"
            f";$STARTTIME={days + EPOCH_DAYS}.{fraction:015d}\n"
            ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"
            ";\n"
            f";   Start time: {moment:%d.%m.%Y %H:%M:%S}.{milliseconds:03d}.000\n"
            ";---------------------------------------------------------------------\n"
            ";   Message   Time    Type    ID     Rx/Tx\n"
            ";   Number    Offset  |  Bus  [hex]  |  Reserved\n"
            ";   |         [ms]    |  |    |      |  |  Data Length Code\n"
            ";   |         |       |  |    |      |  |  |    Data [hex] ...\n"
            ";---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- -- -- -- -- --\n"
        )

    def _text(self, frame: LogFrame, time_ns: int) -> str:
        if time_ns % 1000:
            self.losses["times rounded to the microsecond"] += 1
        whole, fraction = divmod((time_ns + 500) // 1000, 1000)
        self._number += 1
        bus = self.channel_number(frame.channel)
        if not frame.direction:
            self.losses["direction not recorded, written as Rx"] += 1
        identifier = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:04X}"
        kind = "RR" if frame.remote else "DT"
        if frame.fd and not frame.remote:
            kind = (("FD", "BI"), ("FB", "FE"))[frame.brs][frame.esi]
        elif frame.fd:
            self.losses["CAN FD flag of a remote frame"] += 1
        if frame.error:
            kind, identifier = "ER", "-"
            if frame.can_id or frame.extended or frame.fd or frame.remote:
                self.losses["error frame class and flags"] += 1
            if len(frame.data) > 8:
                self.losses["bytes of an error frame after the eighth"] += 1
                frame = frame._replace(data=frame.data[:8])
        return (
            f"{self._number:>7} {whole:>9}.{fraction:03d} {kind} {bus:<2} {identifier:>8} "
            f"{frame.direction or 'Rx'} -  {frame.dlc:<2}   {frame.data.hex(' ').upper()}\n"
        )
