"""When the recorded control unit ran: bit rate, period and phase of its ticks, out of the log alone.

All frames of a step are released together, the computation time after the tick, and the bus sends
the lowest identifier first. The valve command therefore arrives no sooner than its own length, the
blow no sooner than both lengths and an intermission, after the release:

    release >= arrival(ValveCommand) - bits(ValveCommand) / bitrate
    release >= arrival(SafetyBlow) - (bits(ValveCommand) + 3 + bits(SafetyBlow)) / bitrate

with equality whenever the bus was free. The latest bound of a tick is compared with the period's
grid, and the smallest remainder over many ticks is the phase: exact as soon as one tick found the
bus free. A log on a run's own clock (ticks at whole multiples of the period from zero, up to one
blocking before the bound) is recognised and taken as that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import accumulate, pairwise
from statistics import median
from typing import Final, NamedTuple

from can_dbc.codec import spec_of
from can_dbc.e2e import COUNTERS
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    ControllerStatus,
    Gear,
    PositionPulse,
    SafetyBlow,
    ShiftState,
    ValveCommand,
)
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.log_replay.recorded_frames import Arrival, counter_of, is_intact

DEFAULT_BITRATE: Final = 500_000
HEAD_FRAMES: Final = 20_000
"""Frames from the beginning of the log that the survey looks at."""

BLOCKED_NS: Final = 1_200_000
"""No frame of 29 bits lasts longer than this at 125 kbit/s or above (160 bits)."""
NOMINAL: Final = 1e-3
"""Share of a nominal period by which a measured one differs that is the same."""


class Survey(NamedTuple):
    """What the beginning of a log shows of its control unit.

    bitrate: None where the times do not show it. period_ns, sensor_period_ns: None where there are
    not two frames in a row. release_ns: earliest bound of the release of the tick with `first_counter`, moved
    to the phase that all ticks agree on; None without any tick. awake: its first status is not INIT.
    skew: by which share the recorder's clock runs faster than the control unit's; 0 where the ticks do not
    show it. gear: the first one that is confirmed. resolution_ns: all times are multiples of it.
    """

    first_ns: int
    bitrate: int | None
    period_ns: int | None
    sensor_period_ns: int | None
    release_ns: int | None
    first_counter: int
    awake: bool
    skew: float
    gear: Gear | None
    resolution_ns: int
    bounds: int


class Grid(NamedTuple):
    """The recorded unit's ticks: `origin_ns` + k `period_ns`, k from 0, on the log's clock.

    exact: the phase is known to the nanosecond. fresh: tick 0 is the control unit's first step after its
    start; otherwise the log begins in the middle of its work.
    """

    origin_ns: int
    period_ns: int
    computation_ns: int
    bitrate: int
    exact: bool
    fresh: bool
    description: str

    def tick_ns(self, tick: int) -> int:
        """Return the time of a tick on the log's clock, ns."""
        return self.origin_ns + tick * self.period_ns

    def latest_tick(self, arrival: Arrival) -> int:
        """Return the last tick that can have released a frame."""
        frame = arrival.frame
        length_ns = frame_bits(frame.can_id, frame.data) * NS_PER_S // self.bitrate
        released_ns = arrival.time_ns - length_ns + self.slack_ns
        return (released_ns - self.computation_ns - self.origin_ns) // self.period_ns

    @property
    def slack_ns(self) -> int:
        """Return by how much a frame may seem to have been released too early.

        A recorder may round its times, and a frame changed on its way may have been stuffed less.
        """
        changed_ns = 30 * NS_PER_S // self.bitrate
        return changed_ns if self.exact else min(self.period_ns // 8, 200_000 + changed_ns)


def _bounds(arrivals: Iterable[Arrival], bit_ns: int) -> list[tuple[int, int]]:
    """Return (counter, bound in ns) of each tick; without any blow, from the valve commands alone."""
    pairs, singles = [], []
    valves: dict[int, tuple[int, int]] = {}
    blows: dict[int, tuple[int, int]] = {}
    for time_ns, kind, frame in arrivals:
        if kind not in (ValveCommand, SafetyBlow) or not is_intact(kind, frame):
            continue
        counter = counter_of(frame)
        bits = frame_bits(frame.can_id, frame.data)
        (valves if kind is ValveCommand else blows)[counter] = (time_ns, bits)
        if kind is ValveCommand:
            singles.append((counter, time_ns - bits * bit_ns))
        for forgotten in (valves, blows):  # half a round old: its partner was lost
            forgotten.pop((counter + COUNTERS // 2) % COUNTERS, None)
        if counter not in valves or counter not in blows:
            continue
        (valve_ns, valve_bits), (blow_ns, blow_bits) = valves.pop(counter), blows.pop(counter)
        both = valve_bits + INTERMISSION_BITS + blow_bits
        pairs.append((counter, min(valve_ns - valve_bits * bit_ns, blow_ns - both * bit_ns)))
    return pairs or singles


def survey(
    arrivals: Sequence[Arrival], bitrate: int | None = None, period_ns: int | None = None
) -> Survey:
    """Look at the beginning of a log; `bitrate` and `period_ns` where they are known better."""
    shown_bitrate = bitrate or _bitrate(arrivals)
    bit_ns = NS_PER_S // (shown_bitrate or DEFAULT_BITRATE)
    bounds = _bounds(arrivals, bit_ns)
    period_ns = period_ns or _period(bounds)
    release_ns = None
    if bounds:
        first_ns = bounds[0][1]
        release_ns = first_ns
        if period_ns is not None:
            half = period_ns // 2
            release_ns += min((b - first_ns + half) % period_ns - half for _, b in bounds)
    pulses = [
        (counter_of(frame), time_ns)
        for time_ns, kind, frame in arrivals
        if kind is PositionPulse and is_intact(kind, frame)
    ]
    length = spec_of(ControllerStatus).length
    frames = (a.frame for a in arrivals if a.kind is ControllerStatus)
    reports = [frame for frame in frames if len(frame.data) == length]
    gears = (Gear(f.data[2] & 3) for f in reports if is_intact(ControllerStatus, f))
    return Survey(
        first_ns=arrivals[0].time_ns if arrivals else 0,
        bitrate=shown_bitrate,
        period_ns=period_ns,
        sensor_period_ns=_period(pulses),
        release_ns=release_ns,
        first_counter=bounds[0][0] if bounds else 0,
        awake=bool(reports) and reports[0].data[1] >> 4 & 7 != ShiftState.INIT,
        skew=_skew(bounds, period_ns) if period_ns is not None else 0.0,
        gear=next((gear for gear in gears if gear is not Gear.UNKNOWN), None),
        resolution_ns=next(
            step_ns
            for step_ns in (1_000_000, 100_000, 10_000, 1000, 1)
            if all(a.time_ns % step_ns == 0 for a in arrivals)
        ),
        bounds=len(bounds),
    )


def _bitrate(arrivals: Sequence[Arrival]) -> int | None:
    """Return the bit rate at which most frames follow directly on the one before."""
    votes: Counter[int] = Counter()
    close = 0
    for before, after in pairwise(arrivals):
        gap_ns = after.time_ns - before.time_ns
        if not 0 < gap_ns < 2_000_000:
            continue
        close += 1
        bits = frame_bits(after.frame.can_id, after.frame.data) + INTERMISSION_BITS
        for bitrate in (1_000_000, 500_000, 250_000, 125_000):
            if abs(gap_ns - bits * NS_PER_S // bitrate) <= 1000:
                votes[bitrate] += 1
    if not votes:
        return None
    best, count = votes.most_common(1)[0]
    return best if count >= max(3, close // 10) else None


def _period(instants: Sequence[tuple[int, int]]) -> int | None:
    """Return the period of (counter, time): their mean distance, as round as their jitter allows.

    The first and the last instant are each off by one blocking at most, or by what else scatters the steps:
    the mean over n periods by that over n. Of a unit that stood still for a while, which makes the mean longer
    by 2 % and more, the usual step is the period.
    """
    steps = [
        b_ns - a_ns
        for (a, a_ns), (b, b_ns) in pairwise(instants)
        if (b - a) % COUNTERS == 1 and b_ns > a_ns
    ]
    if not steps:
        return None
    usual_ns = median(steps)
    jitter_ns = max(BLOCKED_NS, min(max(steps) - min(steps), 4 * usual_ns))
    periods = lasted_ns = 0
    for (a, a_ns), (b, b_ns) in pairwise(instants):
        passed = (b - a) % COUNTERS  # and whole rounds of the counter, or one less if overtaken
        if b_ns - a_ns < 2_000_000_000:  # else nobody was recorded
            periods += passed + COUNTERS * round(((b_ns - a_ns) / usual_ns - passed) / COUNTERS)
            lasted_ns += b_ns - a_ns
    mean_ns = lasted_ns / max(periods, 1)
    for found_ns in (mean_ns, _mean_of_spans(instants)):
        nominal_ns = max(round((found_ns or 1.0) / 500_000), 1) * 500_000
        if found_ns and abs(nominal_ns - found_ns) <= NOMINAL * nominal_ns:
            return nominal_ns  # clocks that drift apart, no odd period
    if mean_ns > 1.02 * usual_ns:
        return _rounded(usual_ns, 0.02 * usual_ns)
    return _rounded(mean_ns, 2 * jitter_ns / max(periods, 1))


def _mean_of_spans(instants: Sequence[tuple[int, int]]) -> float | None:
    """Return the median of the mean steps over 15 counters in a row, None with fewer than 40 of them.

    A stop of the unit is in few of these spans, and jitter nearly cancels in each.
    """
    size = COUNTERS - 1
    spans = [
        (b_ns - a_ns) / size
        for (a, a_ns), (b, b_ns) in zip(instants, instants[size:], strict=False)
        if (b - a) % COUNTERS == size
    ]
    return median(spans) if len(spans) >= 40 else None


def _rounded(value_ns: float, within_ns: float) -> int:
    """Return the roundest number no farther away than that."""
    for step_ns in (500_000, 100_000, 10_000, 1000):
        rounded_ns = max(round(value_ns / step_ns), 1) * step_ns
        if abs(rounded_ns - value_ns) <= within_ns:
            return rounded_ns
    return max(round(value_ns), 1000)


def _skew(bounds: Sequence[tuple[int, int]], period_ns: int) -> float:
    """Return how fast the earliest bounds drift away from the period's grid, as a share of time.

    The bounds are cut into windows; the earliest of each lie on a line if the clocks drift apart.
    """
    size = len(bounds) // 8
    if size < 20:
        return 0.0
    times_ns = [time_ns for _, time_ns in bounds]
    steps = (round((b - a) / period_ns) for a, b in pairwise(times_ns))
    ticks = list(accumulate(steps, initial=0))
    late = [(t - times_ns[0] - k * period_ns, k) for t, k in zip(times_ns, ticks, strict=True)]
    first, *between, last = (min(late[k * size : (k + 1) * size]) for k in range(8))
    slope = (last[0] - first[0]) / (last[1] - first[1])
    off_ns = max(abs(ns - first[0] - slope * (k - first[1])) for ns, k in between)
    drift = slope / period_ns
    if abs(last[0] - first[0]) < 10_000 + 4 * off_ns or not 2e-6 < abs(drift) < 2e-3:
        return 0.0
    return drift


def make_grid(
    log_head: Survey, period_ns: int, computation_ns: int, free_running: bool = False
) -> Grid:
    """Return the ticks of the recorded unit. `computation_ns`: from a tick to its release.

    `free_running`: the log is of a run in real time, whose ticks are not on the log's clock.

    Raises ValueError when the survey found no tick.
    """
    if log_head.release_ns is None:
        raise ValueError("no tick in the survey")
    bitrate = log_head.bitrate or DEFAULT_BITRATE
    tick_ns = log_head.release_ns - computation_ns
    late_ns = tick_ns % period_ns
    slack_ns = max(log_head.resolution_ns, 2) if log_head.resolution_ns > 1000 else 0
    relative = 0 < log_head.first_ns < NS_PER_S and not free_running
    exact = log_head.resolution_ns <= 1000
    if relative and (late_ns <= BLOCKED_NS or period_ns - late_ns <= slack_ns):
        tick_ns += -late_ns if late_ns <= BLOCKED_NS else period_ns - late_ns
        how = "the log's own clock"
    else:
        exact &= log_head.bitrate is not None
        how = f"the earliest of {log_head.bounds} valve commands and blows"
    first_tick_ns = tick_ns - log_head.first_counter * period_ns
    fresh = not log_head.awake and first_tick_ns >= log_head.first_ns - period_ns
    origin_ns = first_tick_ns if fresh else tick_ns
    description = f"ticks every {period_ns / 1e6:g} ms from {origin_ns / 1e9:.9f} s, by {how}; "
    description += f"{bitrate // 1000} kbit/s{'' if log_head.bitrate else ' assumed'}, "
    description += f"{computation_ns / 1e6:g} ms computation"
    if log_head.resolution_ns > 1000:
        description += f"; to {log_head.resolution_ns / 1e6:g} ms"
    elif not exact:
        description += "; as well as its scattered times allow"
    if not fresh:
        description += "; the log begins while the control unit is at work"
    return Grid(origin_ns, period_ns, computation_ns, bitrate, exact, fresh, description)
