"""End-to-end protection of the safety-relevant messages: AUTOSAR E2E profile 2.

Byte 0 is CRC-8 0x2F over bytes 1 to 7 and the data id that belongs to the counter, the low nibble of byte 1 the
counter. No two messages share one of their 16 data ids (opc4.dbc), so that a masqueraded frame never passes; they
detect every error of one or two bits, also in the counter. The CRC is the autosar-e2e library's; check and state
machine of the receiver follow AUTOSAR PRS E2E Protocol (profile 2 check, E2E_SM), with two additions on the safe side:
a timeout in simulated time, and a SYNC frame, whose sequence is not confirmed yet, is not accepted.
"""

from __future__ import annotations

from collections import Counter, deque
from enum import Enum
from functools import lru_cache
from typing import Any, ClassVar, Generic, TypeVar

from e2e.p02 import e2e_p02_check, e2e_p02_protect

from can_dbc.codec import decode, encode, spec_of
from can_dbc.errors import CodecError
from can_dbc.frame import Frame
from can_dbc.messages import SIGNALS, E2eState

COUNTERS = 16

PROTECTED: tuple[type, ...] = tuple(kind for kind in SIGNALS if spec_of(kind).e2e_data_ids)
"""Message types with counter and CRC."""

M = TypeVar("M")


class E2eStatus(Enum):
    """Result of checking one reception (AUTOSAR E2E_P02CheckStatusType)."""

    OK = "ok"
    OK_SOME_LOST = "ok, some lost"
    REPEATED = "repeated"
    WRONG_SEQUENCE = "wrong sequence"
    ERROR = "error"
    NO_NEW_DATA = "no new data"
    INITIAL = "initial"
    SYNC = "sync"

    __hash__ = object.__hash__  # members are single: no need to hash their names


ACCEPTED = frozenset((E2eStatus.OK, E2eStatus.OK_SOME_LOST))
"""Frames whose content is accepted."""


def _data_ids(message_type: type) -> bytes:
    data_ids = spec_of(message_type).e2e_data_ids
    if not data_ids:
        raise TypeError(f"{message_type.__name__} is not protected end to end")
    return data_ids


def with_counter(message_type: type, frame: Frame, counter: int) -> Frame:
    """Return the frame with that counter and its CRC, for test doubles and faults; senders use `Protector`."""
    return _sealed(frame, counter, _data_ids(message_type))


@lru_cache(maxsize=8192)
def _sealed(encoded: Frame, counter: int, data_ids: bytes) -> Frame:
    """Return the frame with counter and CRC; cached, because messages at rest repeat."""
    data = bytearray(encoded.data)
    data[1] = data[1] & 0xF0 | counter
    e2e_p02_protect(data, data_ids, increment_counter=False)
    return Frame(encoded.can_id, bytes(data))


@lru_cache(maxsize=32768)
def _opened(message_type: type, frame: Frame) -> Any:
    """Return the message of a frame, or a text that says what is wrong with it."""
    spec, data = spec_of(message_type), frame.data
    if frame.can_id != spec.can_id:
        raise ValueError(f"identifier {frame.can_id:#010x} is not a {message_type.__name__}")
    if len(data) != spec.length:
        return f"{len(data)} bytes instead of {spec.length}"
    if not e2e_p02_check(data, spec.e2e_data_ids, length=len(data)):
        return "CRC does not match"
    try:
        return decode(frame)
    except CodecError as error:
        return str(error)


class Protector(Generic[M]):
    """The sending end of one channel: numbers its frames and adds their CRC (AUTOSAR PRS E2E, profile 2)."""

    def __init__(self, message_type: type[M]) -> None:
        self.message_type = message_type
        self.counter = 0
        """Counter of the next frame."""
        self._data_ids = _data_ids(message_type)

    def protect(self, message: M) -> Frame:
        """Return the next frame of the channel.

        Raises TypeError for a message of another type, and CodecError as `can_dbc.codec.encode` does.
        """
        if message.__class__ is not self.message_type:
            raise TypeError(f"{message!r} does not belong to the {self.message_type.__name__}s")
        encoded = encode(message)  # type: ignore[arg-type]  # M is protected, so a message
        frame = _sealed(encoded, self.counter, self._data_ids)
        self.counter = (self.counter + 1) % COUNTERS
        return frame


class Receiver(Generic[M]):
    """The receiving end of one channel: checks each frame and says whether to trust the channel.

    `message` is that of the latest frame with status OK or OK_SOME_LOST, `message_ns` its arrival: use them only while
    `state(now_ns)` is VALID. `counts` counts each status, `reason` says what was wrong with the latest frame of status
    ERROR. `timeout_ns`: time without a good frame after which the channel is INVALID, 3 cycles of the DBC if left out.
    Assumes non-decreasing times. Source: AUTOSAR PRS E2E Protocol, profile 2 and E2E_SM.
    """

    max_delta_counter = 2  # one less than the largest counter step right after a good frame; each check allows one more
    max_repeated = 3  # after more repetitions the sequence must be confirmed by one frame
    window_size = 3  # latest checks that decide on the state
    # least good and most wrong checks among them, with which a channel of this state becomes or stays VALID
    limits: ClassVar = {E2eState.INIT: (1, 1), E2eState.VALID: (1, 1), E2eState.INVALID: (2, 0)}

    def __init__(
        self, message_type: type[M], timeout_ns: int | None = None, start_ns: int = 0
    ) -> None:
        self.message_type = message_type
        cycle_ns = spec_of(message_type).cycle_ns
        self.timeout_ns = 3 * cycle_ns if timeout_ns is None else timeout_ns
        self.status = E2eStatus.NO_NEW_DATA
        self.message: M | None = None
        self.message_ns = -1
        self.counts: Counter[E2eStatus] = Counter()
        self.reason = ""
        _data_ids(message_type)  # refuses a message without protection
        self._state = E2eState.INIT
        self._window: deque[E2eStatus] = deque(maxlen=self.window_size)
        self._alive_ns = self._now_ns = start_ns
        self._waiting_for_first = True
        self._last_counter = 0
        self._max_delta = 0
        self._repeated = 0
        self._unconfirmed = False

    def wait_from(self, now_ns: int) -> None:
        """Count the timeout from now on, if no good frame has come yet."""
        if self._waiting_for_first:
            self._alive_ns = now_ns

    def receive(self, now_ns: int, frame: Frame) -> E2eStatus:
        """Check the frame that arrived now. Raises ValueError for another identifier and for time running backwards."""
        self._advance_to(now_ns)
        if self._max_delta < COUNTERS - 1:
            self._max_delta += 1
        status = self.status = self._check(now_ns, frame)
        self.counts[status] += 1
        if status in ACCEPTED or status is E2eStatus.INITIAL:
            self._alive_ns = now_ns
        self._decide(status)
        return status

    def state(self, now_ns: int) -> E2eState:
        """Return whether the channel may be trusted now."""
        self._advance_to(now_ns)
        return self._state

    def _advance_to(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            raise ValueError(f"time runs backwards: {now_ns} ns after {self._now_ns} ns")
        self._now_ns = now_ns
        if now_ns - self._alive_ns > self.timeout_ns:
            self._state = E2eState.INVALID
            self._window.clear()

    def _check(self, now_ns: int, frame: Frame) -> E2eStatus:
        """E2E_P02Check; a frame with a right CRC that the codec refuses is an ERROR too."""
        message = _opened(self.message_type, frame)  # type: ignore[arg-type]  # a class has a hash
        if isinstance(message, str):
            self.reason = message
            return E2eStatus.ERROR
        status = self._check_counter(frame.data[1] % COUNTERS)
        if status in ACCEPTED:
            self.message = message
            self.message_ns = now_ns
        return status

    def _check_counter(self, counter: int) -> E2eStatus:
        delta = (counter - self._last_counter) % COUNTERS
        if self._waiting_for_first:
            self._waiting_for_first = False
            self._accept(counter)
            return E2eStatus.INITIAL
        if delta == 0:
            self._repeated += 1
            return E2eStatus.REPEATED
        repeated, self._repeated = self._repeated, 0
        is_jump = delta > self._max_delta
        self._accept(counter)
        if is_jump:
            self._unconfirmed = True
            return E2eStatus.WRONG_SEQUENCE
        if repeated > self.max_repeated:
            self._unconfirmed = True
            return E2eStatus.SYNC
        if self._unconfirmed:
            self._unconfirmed = False
            return E2eStatus.SYNC
        return E2eStatus.OK if delta == 1 else E2eStatus.OK_SOME_LOST

    def _accept(self, counter: int) -> None:
        self._last_counter = counter
        self._max_delta = self.max_delta_counter

    def _decide(self, status: E2eStatus) -> None:
        """E2E_SMCheck with the latest `window_size` checks."""
        if self._waiting_for_first and self._state is E2eState.INIT:  # nothing but errors so far
            return
        window = self._window
        window.append(status)
        ok = window.count(E2eStatus.OK) + window.count(E2eStatus.OK_SOME_LOST)
        errors = window.count(E2eStatus.ERROR)
        least_ok, most_errors = self.limits[self._state]
        if ok >= least_ok and errors <= most_errors:
            self._state = E2eState.VALID
        elif self._state is E2eState.VALID or errors > most_errors:
            self._state = E2eState.INVALID
