"""The part of opc4.dbc that programs need, read by regular expressions in 2 ms; importing cantools takes 0.6 s.

What documents the file is left to cantools, with whose values tests/unit/can_dbc/test_contract.py compares these.
"""

from __future__ import annotations

import re
from functools import cache
from os import path
from typing import NamedTuple

DBC_PATH = path.join(path.dirname(path.abspath(__file__)), "opc4.dbc")


class SignalSpec(NamedTuple):
    """A signal: physical = raw * factor + offset, little-endian from bit `start`."""

    name: str
    start: int
    length: int
    signed: bool
    factor: float
    offset: float
    minimum: float
    maximum: float
    unit: str

    @property
    def mask(self) -> int:
        """Largest raw value read as unsigned."""
        return (1 << self.length) - 1


class MessageSpec(NamedTuple):
    """A message; `cycle_ns` is 0 for messages without a period, `e2e_data_ids` empty for unprotected ones."""

    name: str
    can_id: int
    length: int
    senders: tuple[str, ...]
    receivers: frozenset[str]
    signals: tuple[SignalSpec, ...]
    cycle_ns: int
    jitter_ns: int
    e2e_data_ids: bytes

    def signal(self, name: str) -> SignalSpec:
        """Return the signal of that name. Raises KeyError if there is none."""
        return {signal.name: signal for signal in self.signals}[name]


def _number(text: str) -> float:
    """Return an int where the text is one, as cantools does, so that integers stay exact."""
    return float(text) if "." in text else int(text)


def _signal(line: str) -> SignalSpec:
    parts = re.match(
        r" SG_ (\w+) : (\d+)\|(\d+)@1([+-]) \((.+?),(.+?)\) \[(.+?)\|(.+?)\] \"(.*?)\" ", line
    )
    assert parts is not None, line
    name, start, length, sign, *numbers, unit = parts.groups()
    factor, offset, minimum, maximum = map(_number, numbers)
    return SignalSpec(
        name, int(start), int(length), sign == "-", factor, offset, minimum, maximum, unit
    )


@cache
def contract() -> dict[str, MessageSpec]:
    """Return the messages of opc4.dbc by name, in the order of the file, which is read once."""
    with open(DBC_PATH, encoding="ascii") as file:
        text = file.read()
    senders = dict(re.findall(r"^BO_TX_BU_ (\d+) : ([\w,]+);", text, re.MULTILINE))
    values = re.findall(r"^BA_ \"(\w+)\" BO_ (\d+) \"?(\w*)\"?;", text, re.MULTILINE)
    attributes = {(name, number): value for name, number, value in values}
    messages = re.findall(r"^BO_ (\d+) (\w+): (\d+) (\w+)\n((?: SG_ .*\n)*)", text, re.MULTILINE)
    return {
        name: MessageSpec(
            name=name,
            can_id=int(number) & 0x1FFF_FFFF,
            length=int(length),
            senders=tuple(senders.get(number, sender).split(",")),
            receivers=frozenset(
                ",".join(re.findall(r"\" +([\w,]+)$", lines, re.MULTILINE)).split(",")
            ),
            signals=tuple(map(_signal, lines.splitlines())),
            cycle_ns=int(attributes.get(("GenMsgCycleTime", number), 0)) * 1_000_000,
            jitter_ns=int(attributes.get(("GenMsgJitterUs", number), 0)) * 1_000,
            e2e_data_ids=bytes.fromhex(attributes.get(("E2EDataIdList", number), "")),
        )
        for number, name, length, sender, lines in messages
    }
