"""The shifts of one truck judged: read, searched, weighed, and what they would have shown.

Checked by: tests/unit/sil/inference/truck/test_diagnosis.py
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import ParameterSet
from sil.files.quantity import counted
from sil.inference.fit import Show, no_progress
from sil.inference.thresholds import UNNAMED
from sil.inference.truck.causes import offered
from sil.inference.truck.detectable import Detectable, detectable_of
from sil.inference.truck.fit import Fit, Fitter
from sil.inference.truck.search import Search, spread
from sil.inference.truck.verdict import MIN_SHIFTS, Hypothesis, Verdict, decide
from sil.inference.workers import Stages
from sil.j1939.mapping import SignalMapping
from sil.log_replay.recorded_shifts import BETWEEN_GEARS, LEAD_S, RecordedShift, shifts_of

MOST_SHIFTS: Final = 120
"""Shifts that are judged; of more, as many spread evenly over the logs."""
SEARCHED_SHIFTS: Final = 12
"""Shifts that hypotheses are searched with; the best of them are fitted to all."""
LEAST_NOISE_M: Final = 1.4e-5
"""Standard deviation of a position by the timer's resolution alone."""


@dataclass(frozen=True)
class TruckDiagnosis:
    """All that was found of the shifts of one truck; verdict, fitter: None of too few shifts; astray: others that began out of any gear."""

    kind: str
    shifts: tuple[RecordedShift, ...]
    findings: tuple[str, ...]
    noise_m: float = LEAST_NOISE_M
    verdict: Verdict | None = None
    fitters: dict[bool, Fitter] | None = None
    detectable: tuple[Detectable, ...] = ()
    astray: int = 0

    @property
    def failed(self) -> int:
        """How many shifts did not reach their gear, or began out of any."""
        return sum(shift.failed for shift in self.shifts) + self.astray

    def fitter(self, fit: Fit) -> Fitter:
        """Return what a fit is one of."""
        assert self.fitters is not None
        return self.fitters[fit.mounted]

    def chi2(self, item: Hypothesis) -> float:
        """Return chi squared per number that a hypothesis leaves."""
        return self.fitter(item.fit).chi2(item.fit)


def shifts_of_truck(
    logs: Sequence[str],
    parameters: ParameterSet,
    layout: tuple[str | None, str | None],
    skipped: Counter[str],
) -> tuple[list[RecordedShift], tuple[str, ...]]:
    """Return the shifts of one truck's logs, and what is wrong in these; `skipped` counts those left out.

    layout: mapping file and DBC of another layout.  Raises InputError for bad files.
    """
    mapping = SignalMapping(*layout) if any(layout) else None
    shifts: dict[tuple[object, ...], RecordedShift] = {}
    broken: list[str] = []
    read = set[str]()
    for path in logs:
        if (real := os.path.realpath(path)) in read:
            raise InputError(f"{path}: given twice; expected each log once")
        read.add(real)
        faults: list[str] = []
        for shift in shifts_of(path, parameters, mapping, skipped, faults):
            what = shift.begin_s, shift.commands, shift.position_m.tobytes()
            if shifts.setdefault(what, shift) is not shift:
                skipped["that an earlier log holds, too,"] += 1
        broken += [f"{path}: {fault}" for fault in faults]
    return list(shifts.values()), tuple(broken)


def judge(
    shifts: Sequence[RecordedShift],
    parameters: ParameterSet,
    broken: tuple[str, ...] = (),
    show: Show = no_progress,
    workers: int = 1,
    astray: int = 0,
) -> TruckDiagnosis:
    """Judge the shifts of one truck against the plant of a parameter set; broken: what is wrong in its logs.

    astray: how many more shifts began with the stay between gears, which a healthy truck's never does.
    """
    used = spread(shifts, MOST_SHIFTS)
    failed = sum(shift.failed for shift in used)
    if astray and not used:
        text = f"{counted(astray, 'shift')} {BETWEEN_GEARS}"
        return TruckDiagnosis(UNNAMED, (), (text, *broken), astray=astray)
    if len(used) < MIN_SHIFTS and not failed + astray:
        text = f"{counted(len(used), 'usable shift')}; at least {MIN_SHIFTS} are needed to judge"
        return TruckDiagnosis("cannot_tell", tuple(used), (text, *broken))
    noise_m, causes = noise_of(used, parameters), offered(used)
    stages = Stages(show)
    few = spread(used, SEARCHED_SHIFTS)
    search = Search.of(few, parameters, noise_m, causes, workers, used)
    fits = search.run(stages.until(80.0))
    if len(used) > len(few):
        search, fits = search.on_all(used, parameters, noise_m, fits)
    verdict = decide(fits, causes, search.fitters, failed, workers, astray)
    stages.until(90.0)
    fit = verdict.healthy.fit
    shown = detectable_of(search.fitters[fit.mounted], fit, causes, workers)
    findings = (*verdict.findings, *broken)
    return TruckDiagnosis(
        verdict.kind, tuple(used), findings, noise_m, verdict, search.fitters, tuple(shown), astray
    )


def noise_of(shifts: Sequence[RecordedShift], parameters: ParameterSet) -> float:
    """Return the standard deviation of a position: of the record, and of what a calibration left [m]."""
    path = "discrepancy.position_m"
    left_m = parameters.value(path) if path in parameters else 0.0
    return float(np.hypot(rest_noise_m(shifts), left_m))


def rest_noise_m(shifts: Sequence[RecordedShift]) -> float:
    """Return the standard deviation of a position before the first motion, at least the timer's [m]."""
    rests = [s.position_m[s.time_s < LEAD_S] for s in shifts]
    own = [(r - np.mean(r)) ** 2 * len(r) / (len(r) - 1) for r in rests if len(r) > 1]
    if not own:
        return LEAST_NOISE_M
    return float(max(LEAST_NOISE_M, np.sqrt(np.mean(np.concatenate(own)))))
