"""Ten bugs of a firmware, as changes of the shipped one's source, for what is to find them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

from tests.conftest import ROOT


class Bug(NamedTuple):
    """A text of a source file, and what stands there with the bug."""

    file: str
    right: str
    wrong: str


BUGS = {
    "timeout_off_by_one": Bug(
        "controller/shift.py",
        "elif self.attempt < self._retries:",
        "elif self.attempt <= self._retries:",
    ),
    "counter_not_reset": Bug(
        "controller/shift.py",
        "        self.leg = leg\n        self.attempt = 0\n",
        "        self.leg = leg\n",
    ),
    "interlock_lost": Bug(
        "controller/interlock.py",
        "return last_ns is None or now_ns - last_ns >= self._apart_ns",
        "return last_ns is None or now_ns > last_ns",
    ),
    "window_includes_its_limit": Bug(
        "controller/position.py",
        "if position_m >= self._engaged_m:",
        "if position_m > self._engaged_m:",
    ),
    "milliseconds_overflow": Bug(
        "controller/shift.py",
        "        self.event = None\n        self.raised = Fault.NONE\n        if not",
        "        now_ns %= 2_048_000_000\n        self.event = None\n        self.raised = Fault.NONE\n        if not",
    ),
    "filter_not_reset": Bug(
        "controller/position.py",
        "        if self._filter is not None:\n            self._filter.settle(raw_m)\n        self._settled = True",
        "        if self._filter is not None and not self._index:\n            self._filter.settle(raw_m)\n        self._settled = True",
    ),
    "stale_sample_used": Bug(
        "controller/firmware.py",
        "estimate = self._estimator.update(inputs.pulses, not valid)",
        "estimate = self._estimator.update(inputs.pulses, False)",
    ),
    "request_lost_while_venting": Bug(
        "controller/shift.py",
        "        self._confirm_again(observed, self.leg)\n        if not self._serve(now_ns, observed) and now_ns >= self._until_ns:\n            self._change(Event.VENT_OVER)",
        "        self._confirm_again(observed, self.leg)\n        self._served = observed.requested\n        if now_ns >= self._until_ns:\n            self._change(Event.VENT_OVER)",
    ),
    "repeated_counter_accepted": Bug(
        "can_dbc/e2e.py",
        "ACCEPTED = frozenset((E2eStatus.OK, E2eStatus.OK_SOME_LOST))",
        "ACCEPTED = frozenset((E2eStatus.OK, E2eStatus.OK_SOME_LOST, E2eStatus.REPEATED))",
    ),
    "debounce_from_the_wrong_start": Bug(
        "controller/position.py",
        "self.run = self.run + 1 if gear == self.gear else 1",
        "self.run = self.run + 1",
    ),
}


def with_bug(name: str, folder: Path) -> Path:
    """A checkout with this bug in its firmware; `folder` is made."""
    for package in ("controller", "can_dbc"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    bug = BUGS[name]
    source = (folder / bug.file).read_text()
    assert source.count(bug.right) == 1, (name, source.count(bug.right))
    (folder / bug.file).write_text(source.replace(bug.right, bug.wrong))
    return folder
