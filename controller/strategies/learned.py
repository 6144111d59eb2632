"""Programmes from a table, timed by what the unit has learned from its earlier shifts."""

from __future__ import annotations

from math import exp, log
from typing import Annotated, ClassVar, Literal, NamedTuple

from msgspec import Struct

from can_dbc.messages import Gear
from controller.learning import METHODS, Context, Correction
from controller.position import Estimate
from controller.programmes import Nearby, Programme, library
from controller.settings import ControlConfig, bounded
from controller.strategies import Duties, ShiftContext
from controller.strategies.into_gear import PUSH, Command, IntoGear, IntoGearParameters, Progress

COLDEST_K, REFERENCE_K, WARMEST_K = 253.15, 293.15, 343.15
OPEN_S = 0.008
"""Opening delay of the valves (thesis 3.1.3)."""
REPORT_RAD_S = 0.25
"""Scatter of a reported difference of the speeds; one below four times this is none."""
TIMING_S = 0.0007
"""Scatter of the time to which a report belongs."""
KNOWN = 0.03
"""Scatter of the impulse before the synchronizer works, relative."""
MEASURED_S = 0.002
"""Scatter of a release that was found between two reports."""
LONGEST_S = 1e9


class Expected(NamedTuple):
    """When the plain push would be released, s after its start: before and after this shift's reports.

    delay_s: the part of the correction that is a delay.
    """

    context: Context
    prior_s: float
    delay_s: float
    used_s: float


class Learned(IntoGear):
    """Vent and brake by the programme for the release that is expected.

    Expected is the release of the table for speed difference and supply pressure, moved by what
    earlier shifts taught; while the synchronizer works, the fall of the difference corrects it until
    the programme begins. Afterwards the release that was measured teaches the next shift. Without
    valid speeds, with air left in the neutral chamber, and after a fault it is the open loop.
    At most 100 additions, multiplications and comparisons a step and after a shift.
    Assumes that the engine gives no torque meanwhile.
    """

    class Parameters(IntoGearParameters, frozen=True):
        """What the unit knows of truck and valves, and how it learns."""

        method: Literal["sensitivities", "map", "iterative", "search"] = "sensitivities"
        """How the releases that were measured change the next one to be expected."""
        supply_pa: Annotated[float, bounded(1e5, 2e6, "Pa")] = 9e5
        """Supply pressure as reported (AIR1) before the shift."""
        rest_s: Annotated[float, bounded(0.0, 1e6, "s")] = 60.0
        """How long before power-on the neutral chamber was last filled."""
        least_rest_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.3
        """Filled a shorter time ago, the neutral chamber may hold air."""
        impulse_per_rad_s: Annotated[float, bounded(0.01, 1000.0, "N s2/rad")] = 0.25 / 0.09
        """Impulse that the synchronizer needs for each rad/s: inertia by torque per force."""
        close_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.035
        """Closing delay of the valves at 20 degrees Celsius."""
        close_per_k: Annotated[float, bounded(-0.02, 0.02, "1/K")] = -0.0065
        """Relative change of the closing delay with the temperature."""
        late_s: Annotated[float, bounded(-0.02, 0.02, "s")] = 0.0004
        """From a step to its command at the coil."""
        speeds_age_s: Annotated[float, bounded(0.0, 0.1, "s")] = 0.0035
        """Age of a report of the speeds in the step that has it first."""
        still_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.055
        """So long after the start of a push, reports are of the speeds before it."""
        outlier_s: Annotated[float, bounded(0.001, 0.1, "s")] = 0.006
        """A release that is further from the expected one than this, and a tenth of its change with
        the logarithm of the impulse, is an outlier: it teaches nothing."""
        outliers: Annotated[int, bounded(1, 100, "")] = 3
        """So many outliers in a row on the same side are evidence: the direction is learned anew."""
        plain_pushes: Annotated[int, bounded(0, 100, "")] = 2
        """Plain pushes after a fault or a failed attempt."""

    name: ClassVar[str] = "learned"
    has_memory: ClassVar[bool] = True
    parameters: Learned.Parameters

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        super().__init__(config, parameters)
        self.correction: Correction = METHODS[self.parameters.method]()
        self._library = library()
        self.reset()

    def recall(self, memory: bytes) -> None:
        """Take what was learned, if the memory is whole and of this method."""
        self.correction.load(memory)

    @property
    def memory(self) -> bytes:
        """What was learned, with version and checksum."""
        return self.correction.dump()

    def reset(self) -> None:
        """Forget the push; what was learned stays."""
        self._direction: int | None = None  # none before the first step
        self._plain = False
        self._tables: Nearby
        self._close_s = 0.0
        self._sum_rad_s, self._count = 0.0, 0
        self._reported_s = -LONGEST_S
        self._falling: tuple[tuple[float, float], ...] = ()
        self._expected: Expected | None = None
        self._found: tuple[float, float] | None = None
        self._programme: Programme | None = None
        self._target_s = 0.0
        self._undisturbed_s = LONGEST_S
        self._released_s: float | None = None
        self._before_m: float | None = None
        self._fastest_m_s = 0.0

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the duties of the programme, or the open loop's."""
        if self._direction is None:
            self._prepare(now_ns, shift)
        for sample in estimate.samples:
            if self._before_m is not None and self._falling:
                way_m = abs(sample.raw_m - self._before_m)
                self._fastest_m_s = max(self._fastest_m_s, way_m / self.config.sensor.period_s)
            self._before_m = sample.raw_m
        return super().command(now_ns, estimate, shift)

    def _prepare(self, now_ns: int, shift: ShiftContext) -> None:
        """Take what is known before the push: direction, rest, temperature, supply pressure."""
        own = self.parameters
        self._direction = int(shift.leg is Gear.FORWARD)
        filled_ns = shift.energised_ns[1]
        rest_s = own.rest_s if filled_ns is None else 1e-9 * (now_ns - filled_ns)
        self._plain = rest_s < own.least_rest_s or shift.leg is Gear.NEUTRAL or shift.attempt > 0
        if self.correction.plain and not self._plain:
            self.correction.plain -= 1
            self._plain = True
        coil_k = REFERENCE_K if shift.coil_k is None else shift.coil_k
        warmer_k = min(max(coil_k, COLDEST_K), WARMEST_K) - REFERENCE_K
        self._close_s = own.close_s * exp(own.close_per_k * warmer_k)
        self._tables = self._library.near(own.supply_pa, self._close_s)

    def decide(self, progress: Progress) -> Command:
        """Follow the programme that is expected to fit; its first act decides for it."""
        if progress.apart_rad_s is None:
            self._plain = True
        elif progress.apart_s > self._reported_s:
            self._reported_s = progress.apart_s
            self._note(progress.spent_s, progress.apart_s, progress.apart_rad_s)
        if self._plain or self._expected is None:
            return PUSH
        step = round(progress.spent_s / self.config.period_s)
        if self._programme is None:
            self._choose(self._expected, step)
        programme = self._programme
        if programme is None:
            return PUSH
        vents = any(pulse.start <= step < pulse.end for pulse in programme.vents)
        brakes = any(pulse.start <= step < pulse.end for pulse in programme.brakes)
        return Command(not vents, brakes)

    def _choose(self, expected: Expected, step: int) -> None:
        """Take the programme that fits best if this is the step at which it begins."""
        table = self._tables.nearest
        target_s = expected.used_s - (self._close_s - table.close_s)
        programme = table.row(target_s, step)
        if programme is None or step < programme.begin:
            return
        self._programme, self._target_s = programme, target_s
        period_s = self.config.period_s
        acts = [pulse.start * period_s + self._close_s for pulse in programme.vents]
        acts += [pulse.start * period_s + OPEN_S for pulse in programme.brakes]
        self._undisturbed_s = min(acts)

    def _note(self, spent_s: float, apart_s: float, apart_rad_s: float) -> None:
        """Take a report: of the speeds before the push, or while the synchronizer works."""
        if spent_s <= self.parameters.still_s:
            self._sum_rad_s += apart_rad_s
            self._count += 1
            self._expect(self._sum_rad_s / self._count)
        elif self._expected is not None and self._released_s is None:
            before_rad_s = self._sum_rad_s / self._count
            if before_rad_s < 4.0 * REPORT_RAD_S:
                self._plain = True
                return
            self._measure(apart_s, apart_rad_s, before_rad_s)
            if apart_s - self.parameters.speeds_age_s < self._undisturbed_s:
                self._follow(self._expected, apart_s, 1.0 - apart_rad_s / before_rad_s)

    def _expect(self, before_rad_s: float) -> None:
        """Compute when the plain push would be released, from the speeds before it."""
        assert self._direction is not None
        own = self.parameters
        tables = self._tables
        log_impulse = log(max(own.impulse_per_rad_s * before_rad_s, 1.0))
        release_s, slope_s = tables.release(log_impulse)
        first, step = tables.low.log_impulse
        share = (log_impulse - first) / (step * len(tables.low.rows))
        context = Context(self._direction, slope_s, min(max(share, 0.0), 1.0))
        offset_s, delay_s = self.correction.offset_s(context)
        prior_s = release_s + offset_s + own.late_s
        self._expected = Expected(context, prior_s, delay_s + own.late_s, prior_s)

    def _follow(self, expected: Expected, apart_s: float, given: float) -> None:
        """Correct the expected release by the share of the impulse that has been `given`.

        Until the programme acts, the impulse grows as under the plain push. One table is enough:
        under another pressure the impulse of every time is larger by nearly the same factor.
        """
        if not 0.1 < given < 0.9:
            return
        at_s = apart_s - self.parameters.speeds_age_s - expected.delay_s
        table = self._tables.nearest
        spent, rate_s = table.spent(at_s)
        found_s = table.release(spent - log(given))[0] + expected.delay_s
        noise = REPORT_RAD_S * self._count / (given * self._sum_rad_s)
        timing = TIMING_S / rate_s
        variance = noise * noise + timing * timing
        self._found = found_s, variance * expected.context.slope_s * expected.context.slope_s
        if self._programme is None:
            weight = KNOWN * KNOWN / (KNOWN * KNOWN + variance)
            used_s = expected.prior_s + weight * (found_s - expected.prior_s)
            self._expected = expected._replace(used_s=used_s)

    def _measure(self, apart_s: float, apart_rad_s: float, before_rad_s: float) -> None:
        """Find the release between the last report of a difference and the first of none.

        From the last one on the difference falls as before, faster by the trend of the falls.
        """
        if apart_rad_s > 4.0 * REPORT_RAD_S:
            self._falling = (*self._falling, (apart_s, apart_rad_s))[-3:]
            return
        if not self._falling:
            self._plain = True
            return
        last_s, rest_rad_s = self._falling[-1]
        differences = [before_rad_s, *(rad_s for _, rad_s in self._falling)]
        fall = differences[-2] - rest_rad_s
        if len(self._falling) == 3:
            fall += 0.7 * (fall - (differences[-3] - differences[-2]))
        share = rest_rad_s / fall if fall > rest_rad_s else 1.0
        self._released_s = last_s + share * (apart_s - last_s) - self.parameters.speeds_age_s

    def ended(self, now_ns: int, estimate: Estimate, confirmed: bool, healthy: bool) -> None:
        """Compare the release with what was expected, and pass the difference to the method."""
        correction, expected = self.correction, self._expected
        if not (confirmed and healthy):
            correction.plain = self.parameters.plain_pushes
            return
        correction.shifts = min(correction.shifts + 1, 0xFFFFFFFF)
        if self._plain or expected is None or self._released_s is None:
            return
        error_s = self._error_s(expected, self._released_s)
        limit_s = self.parameters.outlier_s + 0.1 * expected.context.slope_s
        if abs(error_s) <= limit_s or correction.is_evidence(
            expected.context.direction, error_s, self.parameters.outliers
        ):
            correction.learn(expected.context, error_s, self._fastest_m_s)

    def _error_s(self, expected: Expected, released_s: float) -> float:
        """Return how much later than expected beforehand the plain push would have been released."""
        late_s = released_s - expected.used_s
        if (programme := self._programme) is not None:
            late_s -= programme.released_s - programme.plain_s
            late_s -= (programme.gain - 1.0) * (self._target_s - programme.plain_s)
            late_s /= programme.gain
        late_s += expected.used_s - expected.prior_s
        if self._found is not None:
            found_s, variance = self._found
            measured = MEASURED_S * MEASURED_S
            share = measured / (measured + variance)
            late_s += share * (found_s - expected.prior_s - late_s)
        return late_s
