"""The coordinator's order of steps on a perfect bus, for runs in memory.

With all participants in this process, a bus without faults and no wall clock, the loop of
`sil.coupling.lockstep` over `sil.coupling.bus` reduces to this one: every frame is encoded,
arbitrated and decoded as there, and arrives at the same nanosecond (same trace hash).
It exists for speed: studies run tens of thousands of shifts.  With `Lockstep`, `BusModel` and
`InProcess` instead, the same runs took 1.5 times the CPU time (lab_n_b 12 to 18 ms, full_shift 24 to
37 ms): 8 us more per frame, for queues, statistics, fault ports, and frames that their receivers ignore.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from functools import lru_cache
from heapq import heappop, heappush

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling.bus import overwritten
from sil.coupling.clock import NS_PER_S, to_seconds
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.coupling.lockstep import TURN_ORDER
from sil.coupling.transports.channel import Participant, ParticipantLost
from sil.recording.run_record import BusFrame
from sil.simulation.build import received

_bits = lru_cache(maxsize=1 << 15)(frame_bits)


def run_quickly(
    participants: Sequence[Participant],
    bitrate: int,
    end_ns: int,
    mailboxes: Container[int] = (),
) -> list[BusFrame]:
    """Run participants to `end_ns`; return the frames that arrived on the bus, in order.

    Of an identifier in `mailboxes` only a sender's newest content waits.
    Raises ParticipantLost when one of them fails.
    """
    order = (*TURN_ORDER, "traffic")
    ranked = sorted(participants, key=lambda one: order.index(one.name))
    try:
        return _loop(ranked, NS_PER_S // bitrate, end_ns, mailboxes)
    finally:
        for one in participants:
            one.close()


def _loop(  # noqa: C901 - a call per step would cost what the loop saves
    ranked: Sequence[Participant], bit_ns: int, end_ns: int, mailboxes: Container[int]
) -> list[BusFrame]:
    inboxes: list[list[tuple[int, Frame]]] = [[] for _ in ranked]
    names = [one.name for one in ranked]
    hearers: dict[int, list[int]] = {}
    for k, name in enumerate(names):
        for can_id in received(name):
            hearers.setdefault(can_id, []).append(k)
    turns = [one.advance for one in ranked]
    following = [one.start() for one in ranked]
    later: list[tuple[int, int, Frame, str]] = []  # released, serial, frame, sender
    ready: list[tuple[int, int, int, Frame, str]] = []  # identifier, released, serial, ...
    on_the_bus: BusFrame | None = None
    arrived: list[BusFrame] = []
    free_ns = serial = 0
    everybody = range(len(ranked))
    gap_ns = INTERMISSION_BITS * bit_ns
    while True:
        now_ns = min(following)
        last = now_ns >= end_ns
        if last:
            now_ns = end_ns
        while True:
            if on_the_bus is not None:
                if on_the_bus.arrival_ns > now_ns:
                    break
                arrived.append(on_the_bus)
                frame = on_the_bus.frame
                for k in hearers.get(frame.can_id, ()):
                    if names[k] != on_the_bus.sender:
                        inboxes[k].append((on_the_bus.arrival_ns, frame))
                on_the_bus = None
            start_ns = free_ns
            if not ready:
                if not later:
                    break
                if later[0][0] > start_ns:
                    start_ns = later[0][0]
            if start_ns >= now_ns:
                break
            while later and later[0][0] <= start_ns:
                released_ns, number, frame, sender = heappop(later)
                entry = (frame.can_id, released_ns, number, frame, sender)
                if not (ready and frame.can_id in mailboxes and overwritten(ready, entry)):
                    heappush(ready, entry)
            _can_id, released_ns, _number, frame, sender = heappop(ready)
            arrival_ns = start_ns + _bits(frame.can_id, frame.data) * bit_ns
            free_ns = arrival_ns + gap_ns
            on_the_bus = BusFrame(released_ns, arrival_ns, sender, frame)
        due = everybody if last else [k for k in everybody if following[k] == now_ns]
        released = []
        for k in due:
            inbox, inboxes[k] = inboxes[k], []
            try:
                frames, following[k] = turns[k](now_ns, inbox)
            except ParticipantLost as lost:
                raise lost.at(to_seconds(now_ns)) from lost.__cause__
            except (InputError, RunError):
                raise
            except Exception as error:  # as when its process dies of it: the run is over
                what = f"failed: {type(error).__name__}: {error}"
                raise ParticipantLost(names[k], what).at(to_seconds(now_ns)) from error
            released.append((k, frames))
        for k, frames in released:
            name = names[k]
            for released_ns, frame in frames:
                serial += 1
                heappush(later, (released_ns, serial, frame, name))
        if last:
            return arrived
