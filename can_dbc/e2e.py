"""End-to-end protection of the safety-relevant messages: AUTOSAR E2E profile 2.

Byte 0 is CRC-8 0x2F over bytes 1 to 7 and the data id that belongs to the counter, the low nibble of byte 1 the
counter. No two messages share one of their 16 data ids (opc4.dbc), so that a masqueraded frame never passes; they
detect every error of one or two bits, also in the counter. The CRC is the autosar-e2e library's; check and state
machine of the receiver follow AUTOSAR PRS E2E Protocol (profile 2 check, E2E_SM), with two additions on the safe side:
a timeout in simulated time, and a SYNC frame, whose sequence is not confirmed yet, is not accepted.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Generic, TypeVar

from e2e.p02 import e2e_p02_check, e2e_p02_protect

from can_dbc.codec import decode, encode, spec_of
from can_dbc.errors import CodecError, InputError
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


@dataclass(frozen=True, slots=True)
class E2eConfig:
    """Tolerance of a receiver; names as in AUTOSAR.

    `timeout_ns`: time without a valid frame after which the channel is INVALID.
    `max_delta_counter_init`: one less than the largest counter step accepted directly after a
    good frame; each check that does not accept a frame allows one step more.
    `max_no_new_or_repeated`: repetitions after which the sequence must be confirmed anew, by
    `sync_counter_init` frames.
    The window holds the latest `window_size` checks; the number of OK and of ERROR among them
    decides when a channel in each state becomes (or stays) VALID.
    Raises InputError for limits that contradict each other.
    """

    timeout_ns: int
    max_delta_counter_init: int = 2
    max_no_new_or_repeated: int = 3
    sync_counter_init: int = 1
    window_size: int = 3
    min_ok_state_init: int = 1
    max_error_state_init: int = 1
    min_ok_state_valid: int = 1
    max_error_state_valid: int = 1
    min_ok_state_invalid: int = 2
    max_error_state_invalid: int = 0

    def __post_init__(self) -> None:
        largest = {
            "timeout_ns": (1, 2**63 - 1),
            "max_delta_counter_init": (1, COUNTERS - 2),
            "max_no_new_or_repeated": (0, COUNTERS - 1),
            "sync_counter_init": (0, COUNTERS - 1),
            "window_size": (1, 255),
            "min_ok_state_init": (1, self.window_size),
            "max_error_state_init": (0, self.window_size - 1),
            "min_ok_state_valid": (1, min(self.min_ok_state_init, self.min_ok_state_invalid)),
            "min_ok_state_invalid": (1, self.window_size),
            "max_error_state_invalid": (0, self.window_size - 1),
            "max_error_state_valid": (self.max_error_state_invalid, self.window_size - 1),
        }
        for name, (low, high) in largest.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"E2E: {name}: {value}; expected {low} to {high}")


def default_config(message_type: type) -> E2eConfig:
    """Return the usual tolerance of a receiver: a timeout of 3 cycles of the DBC."""
    return E2eConfig(timeout_ns=3 * spec_of(message_type).cycle_ns)


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
    ERROR. Assumes non-decreasing times. Source: AUTOSAR PRS E2E Protocol, profile 2 and E2E_SM.
    """

    def __init__(
        self, message_type: type[M], config: E2eConfig | None = None, start_ns: int = 0
    ) -> None:
        self.message_type = message_type
        self.config = config or default_config(message_type)
        self.status = E2eStatus.NO_NEW_DATA
        self.message: M | None = None
        self.message_ns = -1
        self.counts: Counter[E2eStatus] = Counter()
        self.reason = ""
        _data_ids(message_type)  # refuses a message without protection
        self._state = E2eState.INIT
        self._window: deque[E2eStatus] = deque(maxlen=self.config.window_size)
        self._alive_ns = self._now_ns = start_ns
        self._waiting_for_first = True
        self._last_counter = 0
        self._max_delta = 0
        self._no_new_or_repeated = 0
        self._sync = 0

    def wait_from(self, now_ns: int) -> None:
        """Count the timeout from now on, if no good frame has come yet."""
        if self._waiting_for_first:
            self._alive_ns = now_ns

    def receive(self, now_ns: int, frame: Frame | None) -> E2eStatus:
        """Check the frame that arrived now, or None if one was due and none came.

        Raises ValueError for a frame of another identifier and for time running backwards.
        """
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
        if now_ns - self._alive_ns > self.config.timeout_ns:
            self._state = E2eState.INVALID
            self._window.clear()

    def _check(self, now_ns: int, frame: Frame | None) -> E2eStatus:
        """E2E_P02Check; a frame with a right CRC that the codec refuses is an ERROR too."""
        if frame is None:
            self._count_no_new_or_repeated()
            return E2eStatus.NO_NEW_DATA
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
            self._count_no_new_or_repeated()
            return E2eStatus.REPEATED
        if delta > self._max_delta:
            self._no_new_or_repeated = 0
            self._sync = self.config.sync_counter_init
            if self._sync:
                self._accept(counter)
            return E2eStatus.WRONG_SEQUENCE
        self._accept(counter)
        interrupted = self._no_new_or_repeated > self.config.max_no_new_or_repeated
        self._no_new_or_repeated = 0
        if interrupted:
            self._sync = self.config.sync_counter_init
            return E2eStatus.SYNC
        if self._sync:
            self._sync -= 1
            return E2eStatus.SYNC
        return E2eStatus.OK if delta == 1 else E2eStatus.OK_SOME_LOST

    def _accept(self, counter: int) -> None:
        self._last_counter = counter
        self._max_delta = self.config.max_delta_counter_init

    def _count_no_new_or_repeated(self) -> None:
        if self._no_new_or_repeated < COUNTERS - 1:
            self._no_new_or_repeated += 1

    def _decide(self, status: E2eStatus) -> None:
        """E2E_SMCheck with the latest `window_size` checks."""
        nothing_heard = self._waiting_for_first and self._state is E2eState.INIT
        if nothing_heard and status in (E2eStatus.ERROR, E2eStatus.NO_NEW_DATA):
            return
        self._window.append(status)
        window, c = self._window, self.config
        if self._state is E2eState.VALID and window.count(E2eStatus.OK) == len(window):
            return  # nothing but good frames: valid stays valid, whatever the tolerance
        ok = sum(status in ACCEPTED for status in window)
        errors = window.count(E2eStatus.ERROR)
        if self._state is E2eState.VALID:
            if ok < c.min_ok_state_valid or errors > c.max_error_state_valid:
                self._state = E2eState.INVALID
        elif self._state is E2eState.INIT:
            if errors > c.max_error_state_init:
                self._state = E2eState.INVALID
            elif ok >= c.min_ok_state_init:
                self._state = E2eState.VALID
        elif ok >= c.min_ok_state_invalid and errors <= c.max_error_state_invalid:
            self._state = E2eState.VALID
