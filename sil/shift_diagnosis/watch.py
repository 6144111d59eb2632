"""Trucks watched over months: each log taken once, its shifts judged, the truck's track stored.

Checked by: tests/unit/sil/shift_diagnosis/test_watch.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, zip_longest
from pathlib import Path
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.files.cluster import on_cluster
from sil.files.progress import Progress
from sil.files.worker import in_processes
from sil.j1939.mapping import SignalMapping
from sil.shift_diagnosis.change import Change
from sil.shift_diagnosis.confirm import Confirming
from sil.shift_diagnosis.healthy import FIT_SHIFTS, loaded_fit, rest_noise_m
from sil.shift_diagnosis.linear import Floats, Noise, linearise
from sil.shift_diagnosis.loads import CONE, own_loads, with_speeds, without_speeds
from sil.shift_diagnosis.model import Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import Shift, shifts_of
from sil.shift_diagnosis.store import Reference, Store, Taken, Watched
from sil.shift_diagnosis.track import Track
from sil.shift_diagnosis.verdict import LARGEST
from sil.shift_diagnosis.watched_files import in_time, is_observations, observed, require_names

AT_ONCE: Final = 200
"""Shifts that are simulated in one call."""
ODD: Final = 8.0
"""Chi squared by that of the truck's usual shifts from which a shift is odd: reported, not tracked."""
MOST_ODD: Final = 200
CONTINUE: Final = "the logs taken so far are stored; the same command goes on"


def tracked_causes() -> list[Cause]:
    """Return the causes that are tracked: each effect that healthy trucks differ in, leaks, sensor."""
    found: dict[str, Cause] = {}
    for cause in catalogue():
        own = cause.effect
        if own.tolerance or own.cause_class in ("leak", "internal sensor"):
            found.setdefault(own.id, cause)
    return list(found.values())


@dataclass(frozen=True)
class Judged:
    """What a log says of its truck; odd: number, time in s and chi squared of shifts not tracked."""

    track: Track
    reference: Reference | None
    changes: list[Change]
    taken: Taken
    odd: list[tuple[int, float, float]]


State = tuple[str, Path, Track | None, Reference | None]
"""A truck, its next log, and what is known of the truck so far."""


class Watch:
    """A store, and the model that its trucks' shifts are compared with.

    Raises InputError as the store does.
    """

    def __init__(
        self, store: Path, parameters: ParameterSet, mapping: SignalMapping | None = None
    ) -> None:
        self._judge = LogJudge(parameters, mapping)
        self._store = Store(store, parameters)

    @property
    def is_empty(self) -> bool:
        """Whether no log has been taken yet."""
        return self._store.is_empty

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def trucks(self) -> Iterator[Watched]:
        """Yield every truck of the store, by name."""
        return self._store.trucks()

    def take(
        self,
        files: Sequence[tuple[str, Path]],
        progress: Progress,
        workers: int = 1,
        cluster: str | None = None,
    ) -> list[tuple[str, Change]]:
        """Take the logs that the store does not have; return the changes found, by truck.

        Those of a truck are taken by the time at which they begin, or in the order given where one
        of them has no time of day; those of several trucks side by side on worker processes or a
        cluster. Raises InputError for a log that cannot be read, RunError if a worker dies or the
        cluster is not there; those before it are stored.
        """
        new: dict[str, dict[Path, None]] = {}
        for truck, path in files:
            if not self._store.has_path(truck, path):
                new.setdefault(truck, {})[path] = None
        ordered = [[(truck, path) for path in in_time(own)] for truck, own in new.items()]
        if workers > 1 or cluster is not None:
            together = [[own for own in one if own] for one in zip_longest(*ordered)]
        else:
            together = [[own] for one in ordered for own in one]
        found: list[tuple[str, Change]] = []
        done, size = 0, sum(map(len, ordered))
        for several in together:
            for truck, changes in self._take_logs(several, workers, cluster):
                progress(float(done), float(size))
                found += [(truck, change) for change in changes]
                done += 1
        return found

    def _take_logs(
        self, logs: Sequence[tuple[str, Path]], workers: int, cluster: str | None
    ) -> Iterator[tuple[str, list[Change]]]:
        """Judge and store one log each of some trucks."""
        asked: list[State] = []
        for truck, path in logs:
            with self._store.transaction():
                known = self._store.has_content(truck, path)
            if known:
                yield truck, []
            else:
                asked.append((truck, path, *self._store.truck(truck)))
        firsts = [0 if track is None else track.shifts for _t, _p, track, _r in asked]
        if cluster is not None and asked:
            answers = on_cluster(self._judge, asked, cluster, CONTINUE)
        elif workers > 1 and len(asked) > 1:
            answers = in_processes(self._judge, asked, min(workers, len(asked)), CONTINUE)
        else:
            answers = map(self._judge, asked)
        for (truck, path, _track, _reference), first, own in zip(
            asked, firsts, answers, strict=True
        ):
            with self._store.transaction():
                self._store.has_content(truck, path)  # refuses what another truck had just now
                for number, time_s, chi2 in own.odd:
                    self._store.add_odd(truck, number, time_s, path, chi2)
                self._store.add_log(truck, path, first, own.taken)
                self._store.put_truck(truck, own.track, own.reference)
            yield truck, own.changes


class LogJudge:
    """The model that a truck's shifts are compared with; works in another process, too."""

    def __init__(self, parameters: ParameterSet, mapping: SignalMapping | None) -> None:
        self._parameters, self._mapping = parameters, mapping
        self._causes = tracked_causes()
        self._models: dict[bool, PlantModel] = {}

    def __reduce__(self) -> tuple[type[LogJudge], tuple[ParameterSet, SignalMapping | None]]:
        """Return what another process makes it from: the functions of causes cannot leave one."""
        return LogJudge, (self._parameters, self._mapping)

    def __call__(self, state: State) -> Judged:
        """Return what a log says. Raises InputError for one that cannot be read."""
        _truck, path, track, reference = state
        if is_observations(path):
            track, changes, taken = observed(path, track)
            return Judged(track, reference, changes, taken, [])
        return self._shifts(path, track, reference)

    def _shifts(self, path: Path, track: Track | None, reference: Reference | None) -> Judged:
        """Judge the shifts of a log in the order in which they come."""
        track = track or Track.of(tuple(cause.effect.id for cause in self._causes))
        require_names(path, track, [cause.effect.id for cause in self._causes])
        skipped = Counter[str]()
        faults: list[str] = []
        shifts = shifts_of(str(path), self._parameters, self._mapping, skipped, faults)
        changes: list[Change] = []
        found_odd: list[tuple[int, float, float]] = []
        taken, confirm = Taken(), None
        while some := list(islice(shifts, AT_ONCE)):
            some = with_speeds(some, skipped)
            reference = reference or self._reference(some)
            taken = taken.after([shift.begin_s for shift in some])
            model = self._model(reference.mounted)
            at = np.array(reference.values)
            cone = CONE if without_speeds(some) else ()  # a later log may lack what the first had
            free = tuple(dict.fromkeys((*reference.loads, *cone)))
            some = own_loads(model, some, at, free)
            noise = Noise(reference.noise_m, reference.scatter, loads=free)
            if track.is_far:
                track.linearised_at(self._present(model, some, reference, track, noise))
            elif track.drifting:
                track.point = self._present(model, some, reference, track, noise)
            sizes = self._sizes(track.point)
            linear = linearise(model, some, at, self._causes, sizes, noise=noise)
            chi2 = linear.misfit / np.maximum(linear.count, 1)
            odd = (chi2 > ODD * reference.chi2) & (chi2 > ODD) | (linear.count == 0)
            # after a lasting change every shift is far from the first ones: then none is odd
            odd &= bool(np.mean(odd) < 0.1)
            for k in np.flatnonzero(odd).tolist()[:MOST_ODD]:
                found_odd.append((track.shifts, some[k].begin_s, float(chi2[k])))
            n, usual = linear.units, ~odd
            linear = linear.without_cliffs()  # what is about to stick would count by far too much
            times = np.array([shift.begin_s for shift in some])
            information = linear.information[usual][:, n:, n:]
            score = linear.score[usual][:, n:] + information @ linear.values[n:]
            confirm = Confirming(
                track, track.shifts, [some[k] for k in np.flatnonzero(usual)],
                partial(linearise, model, values=at, noise=noise), self._causes, sizes,
            )  # fmt: skip
            changes += track.take(information, score, times[usual], confirm)
        changes += track.end_cell(confirm)
        left_out, fault = sum(skipped.values()), "".join(faults)
        taken = replace(taken, skipped=left_out, fault=fault)
        return Judged(track, reference, changes, taken, found_odd)

    def _present(
        self,
        model: PlantModel,
        shifts: Sequence[Shift],
        reference: Reference,
        track: Track,
        noise: Noise,
    ) -> Floats:
        """Return the sizes to linearise shifts at: none, or what changed so far.

        That is the point which explains the first of them best. Far from their point shifts are
        not linear, and a cause would look like others.
        """
        few, at = shifts[: 2 * FIT_SHIFTS], np.array(reference.values)
        points = [np.zeros(len(self._causes)), *track.moved()]
        costs = []
        for point in points:
            sizes = self._sizes(point)
            linear = linearise(model, few, at, tuple(sizes), sizes, noise=noise)
            chi2 = linear.misfit / np.maximum(linear.count, 1)
            costs.append(float(np.median(np.where(linear.count, chi2, np.inf))))
        return points[int(np.argmin(costs))]

    def _sizes(self, point: Floats) -> dict[Cause, float]:
        """Return the causes that are not absent at a point, with their sizes there."""
        pairs = zip(self._causes, point.tolist(), strict=True)
        return {c: float(np.clip(size, *c.sizes(LARGEST))) for c, size in pairs if size}

    def _model(self, mounted: bool) -> PlantModel:
        if mounted not in self._models:
            self._models[mounted] = PlantModel(self._parameters, mounted)
        return self._models[mounted]

    def _reference(self, shifts: Sequence[Shift]) -> Reference:
        """Fit a truck's own quantities to its first shifts."""
        models = [self._model(mounted) for mounted in (True, False)]
        few = shifts[: 2 * FIT_SHIFTS]
        fitter, best, few = loaded_fit(models, few, Noise(rest_noise_m(few)))
        linear = linearise(fitter.model, few, best.values, noise=fitter.noise)
        chi2 = float(np.median(linear.misfit / np.maximum(linear.count, 1)))
        mounted = fitter.model.mounted
        noise = fitter.noise
        return Reference(
            mounted, best.values.tolist(), noise.position_m, noise.scatter, max(chi2, 0.1), len(few),
            noise.loads,
        )  # fmt: skip
