"""Faults of the bus and of its nodes, in simulated time, drawn by generators that the scenario seeds."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from can_dbc import messages
from can_dbc.codec import can_id_of
from can_dbc.contract import contract
from can_dbc.e2e import COUNTERS, PROTECTED, with_counter
from can_dbc.errors import InputError
from can_dbc.frame import EDP_BIT, PAGE_BITS, Frame
from sil.coupling.bus import BusFrame, ErrorFrame, Transmission
from sil.coupling.clock import NEVER_NS, to_ns

if TYPE_CHECKING:
    MessageName = str
else:
    MessageName = Literal[tuple(s.name for s in contract().values() if not s.can_id & EDP_BIT)]
NodeName = Literal["driver", "controller", "plant"]
FirmwareName = Literal["driver", "controller"]

Instant = Annotated[float, Meta(ge=0.0, le=86400.0)]
DelayTime = Annotated[float, Meta(ge=0.0, le=10.0)]


class Window(NamedTuple):
    """From one instant to before another, ns."""

    start_ns: int
    end_ns: int

    def holds(self, instant_ns: int) -> bool:
        """Return whether the instant is inside."""
        return self.start_ns <= instant_ns < self.end_ns


class _Fault(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"
):
    """Acts from `start_s` to before `end_s`; without an end, for ever.

    What the rules excuse while it acts: `sil.simulation.circumstances`.
    """

    start_s: Instant = 0.0
    """Time from which the fault acts."""
    end_s: Instant | None = None
    """Time at which the fault ends; if left out, never."""


class _FrameFault(_Fault, frozen=True, kw_only=True):
    """Hits every `every`-th frame of `message`, the first included, with `probability`, at most `count`."""

    message: MessageName
    """Message whose frames are hit."""
    every: Annotated[int, Meta(ge=1)] = 1
    """Every how manieth of its frames is hit, the first included."""
    probability: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    """Probability that such a frame is hit."""
    count: Annotated[int, Meta(ge=1)] | None = None
    """Most frames that are hit; if left out, any number."""


class Loss(_FrameFault, frozen=True, kw_only=True, tag="loss"):
    """The frame occupies the bus but arrives nowhere, unnoticed."""


class DetectedCorruption(_FrameFault, frozen=True, kw_only=True, tag="error_frame"):
    """The frame's CRC fails everywhere: an error frame follows, and the sender tries again.

    Hits the first `attempts` transmissions of a frame.
    """

    attempts: Annotated[int, Meta(ge=1, le=32)] = 1
    """How many transmissions of a frame fail in a row."""


class UndetectedCorruption(_FrameFault, frozen=True, kw_only=True, tag="corruption"):
    """The frame arrives with `bits` of its data flipped, drawn at random; CAN's CRC holds."""

    bits: Annotated[int, Meta(ge=1, le=64)] = 1
    """Number of bits that are flipped."""


class Delay(_FrameFault, frozen=True, kw_only=True, tag="delay"):
    """The frame arrives `delay_s` late, and up to `jitter_s` more, drawn in whole microseconds."""

    delay_s: DelayTime
    """Delay of each frame hit."""
    jitter_s: DelayTime = 0.0
    """Largest further delay, drawn at random."""


class FrozenCounter(_FrameFault, frozen=True, kw_only=True, tag="frozen_counter"):
    """The end-to-end counter stays as in the first frame hit; the checksum fits."""


class BusOff(_Fault, frozen=True, kw_only=True, tag="bus_off"):
    """The node's transceiver is off: it neither sends nor receives; what it queues is lost."""

    node: NodeName
    """Node that is bus-off."""


class OtherBitRate(_Fault, frozen=True, kw_only=True, tag="bit_rate"):
    """The node is set to another bit rate: it understands nobody, and nobody understands it.

    Its error flags destroy the frames of others until it is error-passive, after 15 of them. Each of its
    own frames ends in an error frame and is repeated; after 32 it is bus-off and stays silent.
    """

    node: NodeName
    """Node on another bit rate."""


class Dead(_Fault, frozen=True, kw_only=True, tag="dead"):
    """The node executes nothing from `start_s` on, for good; frames already handed over leave."""

    node: FirmwareName
    """Node that dies."""


class Stalled(_Fault, frozen=True, kw_only=True, tag="stalled"):
    """The node executes nothing until `end_s`, then goes on; frames that arrive meanwhile wait for it."""

    node: FirmwareName
    """Node that stalls."""


class Babbling(_Fault, frozen=True, kw_only=True, tag="babbling"):
    """A foreign node sends all the time: `load` of the bus, at `priority`."""

    load: Annotated[float, Meta(gt=0.0, le=3.0)] = 1.0
    """Share of the bus that the frames take."""
    priority: Annotated[int, Meta(ge=0, le=7)] = 0
    """Priority of the frames; 0 is the highest."""


class Replayed(_Fault, frozen=True, kw_only=True, tag="replayed"):
    """An intruder sends each frame of `message` once more, `delay_s` after it arrived."""

    message: MessageName
    """Message whose frames are repeated."""
    delay_s: Annotated[float, Meta(ge=0.001, le=10.0)]
    """Time from a frame's arrival to its repetition."""


class Spoofed(_Fault, frozen=True, kw_only=True, tag="spoofed"):
    """An intruder sends frames of `message` every `period_s`, their content drawn at random."""

    message: MessageName
    """Message whose frames are forged."""
    period_s: Annotated[float, Meta(ge=0.0005, le=1.0)]
    """Period of the forged frames."""


class Sent(_Fault, frozen=True, kw_only=True, tag="sent"):
    """An intruder sends one frame, at `start_s`."""

    can_id: Annotated[int, Meta(ge=0, le=0x1FFF_FFFF)]
    """Its 29-bit identifier, of data page 0: bits 24 and 25 are clear."""
    data: Annotated[str, Meta(pattern=r"^([0-9A-Fa-f]{2} ?){0,8}$")] = ""
    """Its content, two hexadecimal digits a byte, at most 8 bytes."""


Intrusion = Babbling | Replayed | Spoofed | Sent
"""Faults that put frames on the bus; `sil.nodes.simulated` has the node that sends them."""

FrameFault = Loss | DetectedCorruption | UndetectedCorruption | Delay | FrozenCounter
BusFault = FrameFault | BusOff | OtherBitRate | Dead | Stalled | Intrusion
"""Any fault that a scenario may state, by its `kind`."""


class _Selection:
    """Selects the frames that one frame fault hits, and changes what arrives of them."""

    def __init__(self, fault: Any, window: Window, seed: str) -> None:
        self.fault = fault
        self.message_type: type = getattr(messages, fault.message)
        self.hits = 0
        self._can_id = can_id_of(self.message_type)
        self._random = random.Random(seed)
        self._hit_first: set[int] = set()
        """Instants of queueing of the frames whose first transmission was destroyed, ns."""
        self._counter: int | None = None
        self._window = window
        self._candidates = 0

    def picks(self, transmission: Transmission) -> bool:
        if transmission.frame.can_id != self._can_id:
            return False
        if transmission.attempt > 1 and isinstance(self.fault, DetectedCorruption):
            if transmission.attempt > self.fault.attempts:
                self._hit_first.discard(transmission.released_ns)
            return transmission.released_ns in self._hit_first
        if not self._window.holds(transmission.start_ns):
            return False
        if self.fault.count is not None and self.hits >= self.fault.count:
            return False
        self._candidates += 1
        if (self._candidates - 1) % self.fault.every:
            return False
        return bool(self.fault.probability >= 1.0 or self._random.random() < self.fault.probability)

    def apply(
        self, transmission: Transmission, deliveries: Sequence[BusFrame]
    ) -> Sequence[BusFrame] | ErrorFrame:
        fault, draw = self.fault, self._random
        self.hits += 1
        if isinstance(fault, DetectedCorruption):
            self._hit_first.add(transmission.released_ns)
            return ErrorFrame()
        if isinstance(fault, Loss):
            return ()
        if isinstance(fault, Delay):
            jitter_us = round(fault.jitter_s * 1e6)
            late_us = round(fault.delay_s * 1e6) + (draw.randint(0, jitter_us) if jitter_us else 0)
            return [d._replace(arrival_ns=d.arrival_ns + 1000 * late_us) for d in deliveries]
        if isinstance(fault, FrozenCounter):
            if self._counter is None:
                self._counter = transmission.frame.data[1] % COUNTERS
            kind, counter = self.message_type, self._counter
            return [d._replace(frame=with_counter(kind, d.frame, counter)) for d in deliveries]
        return [d._replace(frame=_flipped(d.frame, fault.bits, draw)) for d in deliveries]


class MisfitNode:
    """A node on another bit rate within a window of time, with its error counters.

    Each error that a receiver flags adds 1 and then 8 to its counter; from 128 on it is error-passive
    and disturbs no more. Each failed transmission adds 8 to a sender's; from 256 on it is bus-off
    (ISO 11898-1). Assumptions: none of the frames that it receives or sends passes by chance; bus-off
    is not recovered from.
    """

    def __init__(self, node: str, window: Window) -> None:
        self.node = node
        self.acts = window.holds
        self._receive_errors = self._send_errors = 0

    @property
    def is_off(self) -> bool:
        """Whether the node is bus-off."""
        return self._send_errors >= 256

    def verdict(self, transmission: Transmission) -> ErrorFrame | None:
        """Return the error frame in which a transmission ends, None if it does not."""
        if not self.acts(transmission.start_ns) or self.is_off:
            return None
        if transmission.sender == self.node:
            self._send_errors += 8
            return ErrorFrame(retransmit=not self.is_off)
        if self._receive_errors >= 128:
            return None
        self._receive_errors += 1 + 8
        return ErrorFrame()


class FaultPlan:
    """All faults of one run, for bus model and coordinator. Raises InputError for an impossible one."""

    def __init__(self, faults: Sequence[BusFault], seed: int) -> None:
        self._by_fault: dict[int, _Selection] = {}
        self._off: list[tuple[str, Window]] = []
        self._misfits: list[MisfitNode] = []
        self._down: list[tuple[str, Window]] = []
        for index, fault in enumerate(faults):
            name = f"fault[{index}]"
            window = window_of(fault, name)
            if isinstance(fault, Intrusion):
                continue
            if isinstance(fault, BusOff):
                self._off.append((fault.node, window))
            elif isinstance(fault, OtherBitRate):
                self._misfits.append(MisfitNode(fault.node, window))
            elif isinstance(fault, Dead | Stalled):
                self._down.append((fault.node, window))
            else:
                selection = _Selection(fault, window, f"{seed}:{name}:{fault.message}")
                if isinstance(fault, FrozenCounter) and selection.message_type not in PROTECTED:
                    expected = f"one of {', '.join(kind.__name__ for kind in PROTECTED)}"
                    what = f"{name}.message: {fault.message} carries no counter"
                    raise InputError(f"{what}; expected {expected}")
                self._by_fault[index] = selection
        # Error frames first: what they hit does not arrive yet, so nothing else can happen to it.
        selections = self._by_fault.values()
        self._selections = sorted(
            selections, key=lambda s: not isinstance(s.fault, DetectedCorruption)
        )

    @property
    def hits(self) -> dict[int, int]:
        """Frames hit so far, by the index of the fault."""
        return {index: selection.hits for index, selection in self._by_fault.items()}

    @property
    def touches_frames(self) -> bool:
        """Whether the bus model needs `frame_filter`."""
        return bool(self._selections or self._off or self._misfits)

    def frame_filter(self, transmission: Transmission) -> Iterable[BusFrame] | ErrorFrame:
        """Decide what arrives of one transmission; a `sil.coupling.bus.FrameFilter`."""
        for node, window in self._off:
            began = transmission.start_ns < window.start_ns <= transmission.end_ns
            if began and node == transmission.sender:
                return ErrorFrame(retransmit=False)
        for misfit in self._misfits:
            if error := misfit.verdict(transmission):
                return error
        deliveries: Sequence[BusFrame] = transmission.delivered()
        for selection in self._selections:
            if not selection.picks(transmission):
                continue
            verdict = selection.apply(transmission, deliveries)
            if isinstance(verdict, ErrorFrame):
                return verdict
            deliveries = verdict
        return deliveries

    def is_off(self, sender: str, instant_ns: int) -> bool:
        """Return whether a sender is bus-off; a `sil.coupling.bus.IsOff`."""
        off = any(node == sender and window.holds(instant_ns) for node, window in self._off)
        misfits = (m for m in self._misfits if m.node == sender and m.is_off)
        return off or any(m.acts(instant_ns) for m in misfits)

    def bus_off(self, instant_ns: int) -> frozenset[str]:
        """Return the nodes that do not receive a frame that arrives at this instant."""
        off = [node for node, window in self._off if window.holds(instant_ns)]
        return frozenset(off + [m.node for m in self._misfits if m.acts(instant_ns)])

    def next_event(self, name: str, event_ns: int, period_ns: int) -> int:
        """Return a node's first event from `event_ns` on; `NEVER_NS`: none. period_ns: its last step."""
        moved = True
        while moved and event_ns < NEVER_NS:
            moved = False
            for node, window in self._down:
                if node != name or not window.holds(event_ns):
                    continue
                if window.end_ns >= NEVER_NS or period_ns < 1:
                    return window.end_ns
                event_ns += -(-(window.end_ns - event_ns) // period_ns) * period_ns
                moved = True
        return event_ns


def window_of(fault: BusFault, name: str = "fault") -> Window:
    """Return when a fault acts.  Raises InputError, with its name, for an impossible time."""
    start_ns = to_ns(fault.start_s, f"{name}.start_s")
    if isinstance(fault, Sent) and fault.can_id & PAGE_BITS:
        wrong = f"0x{fault.can_id:08X} is on data page 1 to 3; expected bits 24, 25 clear"
        raise InputError(f"{name}.can_id: {wrong}")
    if fault.end_s is None:
        if isinstance(fault, Stalled):
            raise InputError(f"{name}.end_s: missing; expected a time, or the kind 'dead'")
        return Window(start_ns, NEVER_NS)
    if isinstance(fault, Dead):
        raise InputError(f"{name}.end_s: a dead node stays dead; expected the kind 'stalled'")
    if isinstance(fault, Sent):
        raise InputError(f"{name}.end_s: one frame has no end; expected start_s alone")
    end_ns = to_ns(fault.end_s, f"{name}.end_s")
    if end_ns <= start_ns:
        later = f"expected later than start_s, {fault.start_s} s"
        raise InputError(f"{name}.end_s: {fault.end_s} s; {later}")
    return Window(start_ns, end_ns)


def _flipped(frame: Frame, bits: int, generator: random.Random) -> Frame:
    length = 8 * len(frame.data)
    changed = int.from_bytes(frame.data, "big")
    for bit in generator.sample(range(length), min(bits, length)):
        changed ^= 1 << bit
    return Frame(frame.can_id, changed.to_bytes(len(frame.data), "big"))
