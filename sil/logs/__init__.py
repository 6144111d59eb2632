"""Recorded CAN traffic: candump, ASC, BLF, TRC, MF4 and CSV logs as one kind of frames."""

from sil.logs.convert import ConvertReport, convert
from sil.logs.frame import LogFrame
from sil.logs.merged import Logs, open_logs
from sil.logs.reader import LogReader
from sil.logs.registry import FORMATS, open_log, open_writer
from sil.logs.report import Location, LogReport
from sil.logs.selection import Selection
from sil.logs.writer import LogWriter

__all__ = [
    "FORMATS",
    "ConvertReport",
    "Location",
    "LogFrame",
    "LogReader",
    "LogReport",
    "LogWriter",
    "Logs",
    "Selection",
    "convert",
    "open_log",
    "open_logs",
    "open_writer",
]
