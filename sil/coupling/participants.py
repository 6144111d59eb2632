"""A participant in a process of its own: joins a run, takes its turns, ends with it."""

from __future__ import annotations

import contextlib

from can_dbc.errors import RunError
from can_dbc.messages import StopReason
from sil.coupling.transports.inproc import Participant
from sil.coupling.transports.link import CanLink, Link, LocalLink, Session

START_TIMEOUT_S = 60.0


def open_link(channel: str, start_timeout_s: float = START_TIMEOUT_S) -> Link:
    """Return the link to a run: `local:NAME` (waits for its hub), or a CAN interface's name.

    Raises InputError for a channel that cannot be, RunError when nobody is there in time.
    """
    kind, colon, name = channel.partition(":")
    if kind == "local" and colon:
        return LocalLink(name, start_timeout_s)
    return CanLink(channel)


def take_part(
    participant: Participant,
    link: Link,
    *,
    scenario: int = 0,
    start_timeout_s: float = START_TIMEOUT_S,
) -> None:
    """Run one participant from Hello to Stop; the main loop of `opc4 node`.

    `scenario` tells scenarios apart (0: any).  The participant and the link are closed in the end,
    whatever happens.  Raises InputError when the coordinator refuses the participant, RunError when
    the coordinator dies or ends the run early, and what the participant raises.
    Checked by test_participants.
    """
    with contextlib.ExitStack() as closing:
        closing.callback(link.close)
        closing.callback(participant.close)
        session = Session(participant.name, link, scenario)
        first_ns = participant.start()
        session.join(first_ns, start_timeout_s)
        while (grant := session.next_grant()) is not None:
            try:
                frames, next_ns = participant.advance(grant.now_ns, grant.deliveries)
                session.answer(frames, next_ns)
            except Exception:
                with contextlib.suppress(RunError):  # the first error is the one to report
                    session.fail()
                raise
        if session.ending == StopReason.ABORTED:
            raise RunError(f"{participant.name}: the coordinator ended the run early")
