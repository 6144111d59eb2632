"""J1939 messages without a fixed layout in the DBC: address claim and active faults (DM1)."""

from __future__ import annotations

from can_dbc.frame import Frame, join_id
from can_dbc.messages import Fault
from sil.j1939.transport import BAM_PERIOD_NS, broadcast

ENGINE, TRANSMISSION, SHIFT_CONSOLE, PNEUMATICS = 0, 3, 5, 48
"""Source addresses (SAE J1939, table B2)."""

NAME_FUNCTIONS = {ENGINE: 0, TRANSMISSION: 3, SHIFT_CONSOLE: 5, PNEUMATICS: 36}
"""Function in the NAME of each address (SAE J1939, table B11)."""

PGN_DM1, PGN_CLAIM = 65226, 60928
OWN_SPN = 520_192
"""First of the numbers that are free for manufacturers: here the position sensor."""

TROUBLE_CODES = {
    Fault.POSITION_LOST: (OWN_SPN, 9),
    Fault.POSITION_IMPLAUSIBLE: (OWN_SPN, 2),
    Fault.SENSOR_STUCK: (OWN_SPN, 10),
    Fault.REQUEST_LOST: (525, 9),
    Fault.REQUEST_INVALID: (525, 19),
    Fault.SPEEDS_LOST: (161, 9),
    Fault.SHIFT_TIMEOUT: (523, 7),
    Fault.INTERNAL: (629, 12),
}
"""SPN and FMI of what the firmware finds: requested gear 525, input speed 161, gear 523, unit 629."""


def active_faults(faults: Fault) -> list[Frame]:
    """Return the frames of DM1 (SAE J1939-73): one, or those of the transport protocol.

    Two bytes of lamps (amber if there are faults), then per fault SPN (19 bits), FMI (5 bits) and
    the count of its occurrences (here 1).
    """
    data = bytes((0x04 if faults else 0x00, 0xFF))
    for fault in (f for f in TROUBLE_CODES if f & faults):
        spn, failure = TROUBLE_CODES[fault]
        data += bytes((spn & 0xFF, spn >> 8 & 0xFF, spn >> 16 << 5 | failure, 1))
    if not faults:
        data += bytes(4)
    if len(data) > 8:
        return broadcast(PGN_DM1, TRANSMISSION, data)
    return [Frame(join_id(6, PGN_DM1, TRANSMISSION), data.ljust(8, b"\xff"))]


class FaultSender:
    """Sends DM1 once a second and when the faults change, but not into a message under way."""

    def __init__(self) -> None:
        self._faults = Fault.NONE
        self._next_ns = self._free_ns = 0

    def due(self, now_ns: int, faults: Fault | None) -> list[tuple[int, Frame]]:
        """Return frames with their releases [ns]; `faults` None: those of before."""
        if faults is None:
            faults = self._faults
        if now_ns < self._next_ns and (faults == self._faults or now_ns < self._free_ns):
            return []
        self._faults = faults
        frames = active_faults(faults)
        self._next_ns = now_ns + 1_000_000_000
        self._free_ns = now_ns + len(frames) * BAM_PERIOD_NS
        return [(now_ns + k * BAM_PERIOD_NS, frame) for k, frame in enumerate(frames)]


def address_claim(source: int) -> Frame:
    """Return the claim of an address with its NAME (SAE J1939-81): on-highway, no manufacturer."""
    industry, manufacturer = 1, 0x7FF
    name = industry << 60 | NAME_FUNCTIONS[source] << 40 | manufacturer << 21 | source
    return Frame(join_id(6, PGN_CLAIM, source), name.to_bytes(8, "little"))
