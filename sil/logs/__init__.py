"""Recorded CAN traffic: candump, ASC, BLF, TRC, MF4 and CSV logs as one kind of frames."""

from sil.logs.backend import LogWriter
from sil.logs.convert import ConvertReport, convert
from sil.logs.frame import LogFrame
from sil.logs.reader import LogReader
from sil.logs.registry import FORMATS, open_log, open_writer
from sil.logs.report import LogReport, Place

__all__ = [
    "FORMATS",
    "ConvertReport",
    "LogFrame",
    "LogReader",
    "LogReport",
    "LogWriter",
    "Place",
    "convert",
    "open_log",
    "open_writer",
]
