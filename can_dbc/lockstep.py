"""The control frames of the lockstep, which never travel on a simulated bus.

All have both data page bits set, byte 0 for a participant's number, byte 1 for an additional number
and bytes 2 to 7 for a value. `sil.coupling.transports.wire` says who sends what when.
"""

from __future__ import annotations

from dataclasses import dataclass

from can_dbc.messages import StopReason

NOBODY = 255
NEVER_NS = (1 << 48) - 1


@dataclass(frozen=True, slots=True)
class Start:
    """Coordinator to all: answer with Done and your first event; the run ends at `end_ns`."""

    end_ns: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Coordinator to all: the run is over at `time_ns`."""

    reason: StopReason
    time_ns: int


@dataclass(frozen=True, slots=True)
class Grant:
    """Coordinator to one participant: advance to `time_ns`.

    `frames`: number mod 256 of frames delivered to it since its previous grant.
    """

    participant: int
    frames: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class BusTime:
    """Coordinator to all: the frame that follows arrived at `time_ns`, from `sender`.

    `checksum`: low byte of the CRC-32 of the frame's record.
    """

    sender: int
    checksum: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class Done:
    """Participant to coordinator: granted time reached, `frames` offered (mod 256).

    `next_event_ns`: its next event, `NEVER_NS` for none.
    """

    participant: int
    frames: int
    next_event_ns: int


@dataclass(frozen=True, slots=True)
class Release:
    """Participant to coordinator: the offers that follow are released at `time_ns`."""

    participant: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class Hello:
    """Participant to coordinator: wants to join, speaking `version`, to run `scenario`."""

    participant: int
    version: int
    nonce: int
    scenario: int


@dataclass(frozen=True, slots=True)
class Welcome:
    """Coordinator to one participant: joined; `nonce` as in its Hello."""

    participant: int
    version: int
    nonce: int


@dataclass(frozen=True, slots=True)
class Refused:
    """Coordinator to one participant, or to `NOBODY` in particular: cannot join or send."""

    participant: int
    reason: int
    nonce: int = NEVER_NS


@dataclass(frozen=True, slots=True)
class Failed:
    """Participant to coordinator: cannot go on."""

    participant: int


@dataclass(frozen=True, slots=True)
class Sync:
    """Coordinator to one participant: answer with Ack once everything before is taken."""

    participant: int


@dataclass(frozen=True, slots=True)
class Ack:
    """Participant to coordinator: answer to Sync."""

    participant: int


@dataclass(frozen=True, slots=True)
class Retire:
    """Coordinator to one participant: it is granted no more time."""

    participant: int


@dataclass(frozen=True, slots=True)
class Monitor:
    """Program that only listens to the hub; `echo` 1 when it wants its own frames back."""

    echo: int


@dataclass(frozen=True, slots=True)
class Skip:
    """Coordinator to one participant: the next frame is not for it and not counted."""

    participant: int


ControlMessage = (
    Start
    | Stop
    | Grant
    | BusTime
    | Done
    | Release
    | Hello
    | Welcome
    | Refused
    | Failed
    | Sync
    | Ack
    | Retire
    | Monitor
    | Skip
)
"""Any control frame."""

SIGNALS: dict[type, tuple[str, ...]] = {
    Start: ("EndTime",),
    Stop: ("StopReason", "StopTime"),
    Grant: ("Participant", "Frames", "GrantedTime"),
    BusTime: ("Sender", "Checksum", "ArrivalTime"),
    Done: ("Participant", "Frames", "NextEvent"),
    Release: ("Participant", "ReleaseTime"),
    Hello: ("Participant", "Version", "Nonce", "Scenario"),
    Welcome: ("Participant", "Version", "WelcomeNonce"),
    Refused: ("Participant", "RefusalReason", "RefusedNonce"),
    Failed: ("Participant",),
    Sync: ("Participant",),
    Ack: ("Participant",),
    Retire: ("Participant",),
    Monitor: ("Echo",),
    Skip: ("Participant",),
}
"""Signals of each control frame in the order of its fields."""
