"""Worst-case response times of the messages on a CAN bus.

For message m with transmission time C_m (worst-case stuffing, intermission included), period T_m
and queueing jitter J_m, blocked by at most one frame of lower priority, B_m = max of their C:

    busy period  t = B_m + sum over k in hep(m) of ceil((t + J_k) / T_k) C_k,
    instances    Q_m = ceil((t + J_m) / T_m),
    queueing     w(q) = B_m + q C_m + sum over k in hp(m) of ceil((w(q) + J_k + tau_bit) / T_k) C_k,
    response     R_m = max over q < Q_m of J_m + w(q) - q T_m + C_m,

all smallest fixed points, in whole nanoseconds. Looking at the first instance alone, as in the
analysis of 1994, is optimistic.
Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis:
refuted, revisited and revised", Real-Time Systems 35 (2007), section 3.2.
Assumes: perfect bus, every node always offers its most urgent frame, messages independent.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING

from can_dbc.contract import contract
from can_dbc.errors import InputError
from can_dbc.messages import TRUCK
from sil.coupling.bus import BusModel
from sil.coupling.frame_bits import INTERMISSION_BITS, longest_frame_bits

if TYPE_CHECKING:
    from cantools.database import Database


@dataclass(frozen=True, slots=True)
class PeriodicMessage:
    """A message of the analysis; times in ns. `jitter_ns`: greatest lateness against strictly periodic."""

    name: str
    can_id: int
    period_ns: int
    length: int = 8
    jitter_ns: int = 0
    extended: bool = True

    @property
    def rank(self) -> tuple[int, int, int]:
        """The priority, of which the smallest wins: the first 11 bits, then standard before extended."""
        if self.extended:
            return self.can_id >> 18, 1, self.can_id & 0x3FFFF
        return self.can_id, 0, 0


@dataclass(frozen=True, slots=True)
class ResponseTime:
    """C, B and R of one message in ns; R from the period's start, jitter included, to the next frame."""

    message: PeriodicMessage
    transmission_ns: int
    blocking_ns: int
    response_ns: int

    @property
    def in_time(self) -> bool:
        """Whether the message always meets its deadline, the end of its period."""
        return self.response_ns <= self.message.period_ns


def contract_messages(
    period_ns: Mapping[str, int] | None = None, jitter_ns: Mapping[str, int] | None = None
) -> tuple[PeriodicMessage, ...]:
    """Return the periodic messages of opc4.dbc; periods and jitters by message name replace its own.

    Those of a truck are among them only if they have a period in `period_ns`.
    """
    periods, jitters = period_ns or {}, jitter_ns or {}
    truck = {kind.__name__ for kind in TRUCK}
    return tuple(
        PeriodicMessage(
            *(spec.name, spec.can_id, periods.get(spec.name, spec.cycle_ns), spec.length),
            jitters.get(spec.name, spec.jitter_ns),
        )
        for spec in contract().values()
        if spec.cycle_ns and (spec.name in periods or spec.name not in truck)
    )


def database_messages(database: Database, source: str = "DBC") -> tuple[PeriodicMessage, ...]:
    """Return the messages with a cycle time of a database read by `can_dbc.dbc.load_dbc`.

    `source`: its name in messages. Raises InputError when there is none or one is longer than a classic frame.
    """
    periodic = [message for message in database.messages if message.cycle_time]
    for message in periodic:
        if message.length > 8:
            expected = "expected at most 8, the analysis covers classic CAN only"
            raise InputError(f"{source}: {message.name}: {message.length} bytes; {expected}")
    if not periodic:
        raise InputError(
            f"{source}: no message has a cycle time (GenMsgCycleTime); expected at least one, or a log "
            "of the bus (--log) to measure them from"
        )
    return tuple(
        PeriodicMessage(
            *(x.name, x.frame_id, round(x.cycle_time * 1e6), x.length), extended=x.is_extended_frame
        )
        for x in periodic
    )


def transmission_ns(message: PeriodicMessage, bitrate: int) -> int:
    """Return C_m, the longest frame of the message and the intermission after it, in ns."""
    bits = longest_frame_bits(message.length, message.extended) + INTERMISSION_BITS
    return bits * BusModel(bitrate).bit_ns


def utilisation(messages: Iterable[PeriodicMessage], bitrate: int) -> Fraction:
    """Return the share of the bus that the messages take with worst-case stuffing: sum of C / T."""
    return sum((Fraction(transmission_ns(x, bitrate), x.period_ns) for x in messages), Fraction(0))


def response_times(messages: Sequence[PeriodicMessage], bitrate: int) -> tuple[ResponseTime, ...]:
    """Return the worst-case response times by the equations above, highest priority first.

    Raises InputError for a utilisation above 1, equal identifiers, periods not above 0, negative jitter.
    """
    ranked = sorted(messages, key=lambda message: message.rank)
    for message in ranked:
        if message.period_ns <= 0 or message.jitter_ns < 0:
            what = f"period {message.period_ns} ns, jitter {message.jitter_ns} ns"
            expected = "expected a period above 0 and a jitter of at least 0"
            raise InputError(f"bus: {message.name}: {what}; {expected}")
    for first, second in pairwise(ranked):
        if first.rank == second.rank:
            what = f"{first.name} and {second.name} share identifier {first.can_id:#x}"
            raise InputError(f"bus: {what}; expected different identifiers")
    total = utilisation(ranked, bitrate)
    if total > 1:
        raise InputError(
            f"bus: worst-case load {float(total):.1%} at {bitrate} bit/s: response times are "
            "unbounded; expected at most 100 %, so raise the bit rate or the periods"
        )
    bit_ns = BusModel(bitrate).bit_ns
    costs = [transmission_ns(message, bitrate) for message in ranked]
    return tuple(_response_time(ranked, costs, index, bit_ns) for index in range(len(ranked)))


def _response_time(
    ranked: Sequence[PeriodicMessage],
    costs: Sequence[int],
    index: int,
    bit_ns: int,
    most: int = 20_000,
) -> ResponseTime:
    message, cost = ranked[index], costs[index]
    higher = list(zip(ranked[:index], costs[:index], strict=True))
    blocking = max(costs[index + 1 :], default=0)

    def interference(until_ns: int, sources: Sequence[tuple[PeriodicMessage, int]]) -> int:
        return sum(-(-(until_ns + k.jitter_ns) // k.period_ns) * c for k, c in sources)

    busy, longer, steps = 0, cost, 0
    while longer != busy and steps < most:
        busy, steps = longer, steps + 1
        longer = blocking + interference(busy, [*higher, (message, cost)])
    instances = -(-(busy + message.jitter_ns) // message.period_ns)
    if longer != busy or instances > most:
        raise InputError(
            f"bus: {message.name}: with the more urgent messages it loads the bus so close to "
            "100 % that its busy period has no useful end; expected a lower load"
        )
    response = 0
    queueing = blocking
    for instance in range(instances):
        queueing = max(queueing, blocking + instance * cost)
        before = blocking + instance * cost
        while (longer := before + interference(queueing + bit_ns, higher)) != queueing:
            queueing = longer
        response = max(response, message.jitter_ns + queueing - instance * message.period_ns + cost)
    return ResponseTime(message, cost, blocking, response)
