"""The main loop of a participant that joins a run from its own process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from can_dbc.errors import RunError
from can_dbc.messages import StopReason
from sil.coupling.transports.inproc import Participant
from sil.coupling.transports.link import CanLink, Link, LocalLink, Session
from sil.coupling.transports.remote import silent

START_TIMEOUT_S = 60.0


def open_link(
    channel: str, start_timeout_s: float = START_TIMEOUT_S, say: Callable[[str], None] = silent
) -> Link:
    """Return the link to a run: `local:NAME` (waits for its hub), or a CAN interface's name.

    `say` takes the message that the hub is waited for.
    Raises InputError for a channel that cannot exist, RunError when no hub comes in time.
    """
    kind, _, name = channel.partition(":")
    return LocalLink(name, start_timeout_s, say) if kind == "local" else CanLink(channel)


def take_part(
    participant: Participant,
    link: Link,
    *,
    scenario: int = 0,
    start_timeout_s: float = START_TIMEOUT_S,
    say: Callable[[str], None] = silent,
) -> None:
    """Run one participant from Hello to Stop; the main loop of `opc4 node`.

    `scenario`: the number of the scenario, or 0 for any.  `say` takes the message that no run has
    answered yet.  The participant and the link are closed at the end in any case.  Raises InputError when the coordinator refuses the participant, RunError when
    the coordinator dies or ends the run early, and what the participant raises.
    """
    with contextlib.ExitStack() as closing:
        closing.callback(link.close)
        closing.callback(participant.close)
        session = Session(participant.name, link, scenario)
        first_ns = participant.start()
        session.join(first_ns, start_timeout_s, say)
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
