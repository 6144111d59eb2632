"""Learn from shift to shift when to vent and when to brake."""

from __future__ import annotations

import struct
import zlib
from typing import ClassVar

from controller.position import Estimate
from controller.strategies.into_gear import PUSH, Command, IntoGear, IntoGearParameters, Progress

VERSION = 0
LAYOUT = struct.Struct("<4sBI")
MAGIC = b"OPC4"


class Learned(IntoGear):
    """Not learning yet: the open loop, with a memory that counts the shifts."""

    class Parameters(IntoGearParameters, frozen=True):
        """What the unit is given from outside."""

        supply_pa: float = 9e5

    name: ClassVar[str] = "learned"
    has_memory: ClassVar[bool] = True
    parameters: Learned.Parameters

    _shifts = 0

    def recall(self, memory: bytes) -> None:
        """Take the count from a memory of this version whose checksum is right."""
        body, checksum = memory[:-4], memory[-4:]
        if len(memory) == LAYOUT.size + 4 and zlib.crc32(body).to_bytes(4, "little") == checksum:
            magic, version, shifts = LAYOUT.unpack(body)
            if (magic, version) == (MAGIC, VERSION):
                self._shifts = shifts

    @property
    def memory(self) -> bytes:
        """The count, versioned and with a checksum."""
        body = LAYOUT.pack(MAGIC, VERSION, self._shifts)
        return body + zlib.crc32(body).to_bytes(4, "little")

    def reset(self) -> None:
        """Nothing to forget."""

    def ended(self, now_ns: int, estimate: Estimate, confirmed: bool, healthy: bool) -> None:
        """Count the shifts that were done without a fault."""
        if confirmed and healthy:
            self._shifts = min(self._shifts + 1, 0xFFFFFFFF)

    def decide(self, progress: Progress) -> Command:
        """Push."""
        return PUSH
