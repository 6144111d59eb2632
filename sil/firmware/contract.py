"""opc4.h as a whole, and the memory layout of its two records in a module."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from can_dbc import c_header
from can_dbc.codec import spec_of
from can_dbc.frame import MAX_ID, Frame
from controller import c_settings
from controller.config import FirmwareConfig

MAX_ARRIVED, MAX_SENT, MAX_SIGNALS = 1024, 160, 32
"""Frames that a step can be given and can send, and signals it can trace, as in opc4.h."""

FRAME = struct.Struct("<q8sIB3x")
HEAD = struct.Struct("<qII")
COUNTS = struct.Struct("<II")
SIGNAL = struct.Struct("<dI4x")
FAILURE = struct.Struct("<III")
SIGNALS_AT = COUNTS.size + MAX_SENT * FRAME.size
FAILURE_AT = SIGNALS_AT + MAX_SIGNALS * SIGNAL.size


class Step(NamedTuple):
    """What a step is given: its time in ns, and the frames that arrived with their times in ns."""

    now_ns: int
    frames: tuple[tuple[int, Frame], ...]
    lost: int  # frames that did not fit into this or an earlier step


@cache
def header() -> str:
    """Return opc4.h."""
    text = Path(__file__).with_name("opc4_base.h").read_text(encoding="ascii")
    text = text.replace("@SETTINGS@\n", c_settings.declaration())
    text = text.replace("@MESSAGES@\n", c_header.header())
    return text.replace("@CONTRACT@", str(crc32(text.encode())))


@cache
def contract_number() -> int:
    """Return the number that a module made with this header carries."""
    return int(header().partition("fw_contract = ")[2].partition("u;")[0])


@cache
def settings_size() -> int:
    """Return the size of the settings, at whose end the rest of `fw_in` begins."""
    return len(c_settings.content(FirmwareConfig()))


@cache
def received() -> frozenset[int]:
    """Return the identifiers of the frames that a firmware is given."""
    kinds = c_header.messages()
    return frozenset(spec_of(k).can_id for k in kinds if c_header.NODE in spec_of(k).receivers)


def pack_step(step: Step) -> bytes:
    """Return the bytes of `fw_in` after its settings."""
    frames = [FRAME.pack(at_ns, data, can_id, len(data)) for at_ns, (can_id, data) in step.frames]
    return b"".join((HEAD.pack(step.now_ns, len(frames), step.lost), *frames))


def unpack_frames(content: memoryview) -> list[Frame]:
    """Return the frames in the bytes of `fw_out.frames`. Raises ValueError for one that is none."""
    frames: list[Frame] = []
    for _, data, can_id, length in FRAME.iter_unpack(content):
        if length > 8 or can_id > MAX_ID:
            what = f"{length} bytes" if length > 8 else f"identifier {can_id:#x}"
            raise ValueError(
                f"frame {len(frames)} of the step has {what}; expected a frame of classic CAN, "
                "29-bit identifier and at most 8 bytes"
            )
        frames.append(Frame(can_id, data if length == 8 else data[:length]))
    return frames
