"""Programmes from a table, timed by what the unit has learned from its earlier shifts."""

from __future__ import annotations

from math import ceil, copysign, exp, log, sqrt
from typing import Annotated, ClassVar, Literal, NamedTuple

from msgspec import Struct

from can_dbc.messages import Gear
from controller.clocks import Delays
from controller.coil import Coil
from controller.learning import (
    METHODS,
    Context,
    Correction,
    Offset,
    heavier_by,
)
from controller.position import Estimate
from controller.programmes import (
    CAREFUL,
    LATE,
    LIGHTEST,
    PER_LEVEL,
    SOFTEST,
    STRONG,
    Nearby,
    Programme,
    library,
)
from controller.settings import ControlConfig, bounded
from controller.strategies import Duties, ShiftContext
from controller.strategies.into_gear import PUSH, Command, IntoGear, IntoGearParameters, Progress
from controller.strategies.motion import START_S, Motion
from controller.strategies.release import REPORT_RAD_S, Release

COLDEST_K, REFERENCE_K, TABLES_K, WARMEST_K = 253.15, 293.15, 323.15, 343.15
SLOWEST_S = 0.0045
"""Valves that open later by more than this have no programme."""
AIRLESS_S = 0.0001
"""Air in neutral that delays a release by more than this delays the onset, too, but by less."""
SUPPLY_PA = 0.2e5
"""Nor has a supply that is further than this from the nearest table."""
WARM_K, DRAG_FOLD_K = 328.15, 26.0
"""A warm unit, and its cooling by which the drag of the oil, which is colder then, grows e-fold."""
UNSTEADY_RAD_S = 12.0 * REPORT_RAD_S
"""A difference before the push that is further from the one before it is no speed."""
TIMING_VARIANCE = 0.0007 * 0.0007
"""Of the time to which a report belongs, s2."""
KNOWN, KNOWN_S = (0.055, 0.05), (0.0025, 0.0016)
"""Scatter of the release for which the careful and the strong programmes were made: of the impulse,
relative, and in s, whichever is less."""
LIGHT_SHARE, WEIGHED_WELL = 0.22, 0.03
"""Lighter shifts, by their row, weigh the teeth: they are pushed plainly until the meshing force of their
gear is known so well."""
MESH_VARIANCE = 0.02 * 0.02
"""Square of the scatter of the meshing force from shift to shift: assumed."""
BEARS, BEARS_MORE = (0.14, 0.062), (0.2315, 0.112)
"""By which share more meshing force than that of the tables the careful programmes are made to bear,
and the strong ones than that of their level: at `LIKELY` and at `UNLIKELY` standard deviations."""
LIKELY, UNLIKELY = 2.2, 4.0
"""Standard deviations that happen together with others; from which on something else is wrong."""
UNLIKELY_SQUARE = UNLIKELY * UNLIKELY
REST_S, REST_CLOSE_S, AIR_S, AIR_FOLD_S = 0.2, 0.035, 0.001, 0.0265
"""So long after neutral was filled through a valve with this closing delay, its air delays a release by
so much, and less e-fold with every last; fitted to plain pushes of 25 to 230 N s, 0.16 to 0.3 s after."""
EARLY_VARIANCE = 0.0012 * 0.0012
"""More of the release by a programme that began before the stay moved, s2."""
STALLED_S = 0.04
"""From release to arrival; after a programme it is 28 ms at most in 8 healthy trucks (1,526 shifts). What is
more counts as an error of the release: the stay was stopped at the teeth, as by a valve that failed."""
OFF_M = 0.0008
"""Position before the stay moves, from neutral, from which on the sensor or its temperature is wrong: by
16 K, five times the scatter of a thermometer."""
LONGEST_S = 1e9
DOUBTED, SURPRISED = 1.5, 1.9
"""Mean square of the latest errors, by what was expected of them: from the first on a programme
needs reports of this shift that alone tell the release well enough, from the second on every push is plain.
In 12 healthy trucks (960 shifts) it is 1.0 in the mean, in 2 % above the first and never above the second."""


class Expected(NamedTuple):
    """When the plain push would be released, s after its start: before and after this shift's reports.

    age_s: of a report of the speeds; noise, timing: relative scatter of what it says, and variance of the time
    to which it belongs in s2. variance: of the release now. limits: what a careful programme and a strong
    one bear of it.
    """

    context: Context
    prior_s: float
    used_s: float
    age_s: float
    noise: float
    timing: float
    offset: Offset
    variance: float
    limits: tuple[float, float]


class Learned(IntoGear):
    """Fill the neutral chamber by the programme for the release that is expected.

    Expected is the release of the table for speed difference and supply pressure, moved by what
    earlier shifts taught; while the synchronizer works, the fall of the difference corrects it until
    the programme begins. Afterwards the measured release teaches the next shift. Without valid speeds
    or position before it begins, with air left in neutral, and after a fault it is the open loop.
    At most 100 operations a step, 300 after a shift. Assumes no torque.
    """

    class Parameters(IntoGearParameters, frozen=True):
        """What the unit knows of truck and valves, and how it learns."""

        method: Literal["sensitivities", "map", "iterative", "search"] = "sensitivities"
        """How the releases that were measured change the next one to be expected."""
        closing_follows_current: bool = False
        """Whether the valves close sooner the less current is in their coils. Without, a filling cannot be
        short enough, and every push is plain."""
        speeds_agreed: bool = False
        """Whether the reported speeds agreed in the last gear before power-on. If not, every push is plain
        until they have: an input speed that is wrong by a constant looks right in neutral."""
        supply_pa: Annotated[float, bounded(1e5, 2e6, "Pa")] = 9e5
        """Supply pressure as reported (AIR1) before the shift."""
        rest_s: Annotated[float, bounded(0.0, 1e6, "s")] = 60.0
        """How long before the first push the neutral chamber was last filled, if not by this unit."""
        least_rest_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.2
        """Filled a shorter time ago, the neutral chamber holds too much air for a programme."""
        scatter: Annotated[float, bounded(0.0, 0.5, "")] = 0.02
        """Scatter of the synchronizer's friction from shift to shift, relative: assumed."""
        impulse_per_rad_s: Annotated[float, bounded(0.01, 1000.0, "N s2/rad")] = 0.25 / 0.09
        """Impulse that the synchronizer needs for each rad/s: inertia by torque per force."""
        close_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.035
        """Closing delay of the valves at 20 degrees Celsius."""
        close_per_k: Annotated[float, bounded(-0.02, 0.02, "1/K")] = -0.0065
        """Relative change of the closing delay with the temperature."""
        late_s: Annotated[float, bounded(-0.02, 0.02, "s")] = 0.0004
        """From a step to its command at the coil."""
        opens_later_s: Annotated[float, bounded(-0.02, 0.02, "s")] = 0.0
        """How much later than nominal the valves opened at first, all three, if that was measured."""
        open_s_per_k: Annotated[float, bounded(-0.001, 0.001, "s/K")] = 9.2e-6
        """Change of the opening delay with the temperature; the tables are for 50 degrees Celsius."""
        speeds_age_s: Annotated[float, bounded(0.0, 0.1, "s")] = 0.0065
        """Age of a report of the speeds in the step that has it first, if nothing is learned."""
        still_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.055
        """So long after the start of a push, reports are of the speeds before it."""
        outlier_s: Annotated[float, bounded(0.001, 0.1, "s")] = 0.006
        """A release that is further from the expected one than this, and than four standard
        deviations, is an outlier: it teaches nothing."""
        outliers: Annotated[int, bounded(1, 100, "")] = 3
        """So many outliers in a row on the same side are evidence: the direction is learned anew."""
        plain_pushes: Annotated[int, bounded(0, 100, "")] = 2
        """Plain pushes after a fault, a failed attempt or an outlier."""

    name: ClassVar[str] = "learned"
    has_memory: ClassVar[bool] = True
    parameters: Learned.Parameters

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        super().__init__(config, parameters)
        self.correction: Correction = METHODS[self.parameters.method]()
        self._library = library()
        self._scatter = self.parameters.scatter * self.parameters.scatter
        self.reset()

    def recall(self, memory: bytes) -> None:
        """Take what was learned, if the memory is whole and of this method."""
        self.correction.load(memory)

    @property
    def memory(self) -> bytes:
        """What was learned, with version and checksum."""
        return self.correction.dump()

    @property
    def is_committed(self) -> bool:
        """From the start of a first filling to the end of the last one."""
        programme = self._programme
        return self._is_begun and programme is not None and self._filling < len(programme.fillings)

    def reset(self) -> None:
        """Forget the push; what was learned stays."""
        self._direction: int | None = None  # none before the first step
        self._plain, self._waits = False, False
        self._has_ended, self._is_begun, self._was_begun = False, False, False
        self._is_weighed, self._is_fresh, self._is_busy, self._is_turn = False, False, False, True
        self._careful: tuple[int, ...] = ()
        self._strong: tuple[int, ...] = ()
        self._tables: Nearby
        self._close_s, self._late_s, self._nominal_s = 0.0, 0.0, 0.0
        self._cold, self._drag = 0.0, 0.0
        self._sum_rad_s, self._count = 0.0, 0
        self._last_rad_s: float | None = None
        self._reported_s = -LONGEST_S
        self._expected: Expected | None = None
        self._found: tuple[float, float] | None = None
        self._programme: Programme | None = None
        self._coil: Coil
        self._filling, self._delay_s = 0, 0.0
        self._target_s = 0.0
        self._delays, self._has_delays = Delays(), False
        self._release = Release()
        stroke_m, supply_pa = self.config.windows.stroke_m, self.parameters.supply_pa
        self._motion = Motion(self.config.sensor.period_s, stroke_m, supply_pa)

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the duties of the programme, or the open loop's."""
        if self._direction is None:
            self._prepare(now_ns, shift)
        elif not self._has_delays:
            self._has_delays = True
            self._delays = self._delayed(None)
        if self._expected is None and shift.apart_rad_s is not None:
            self._drag = copysign(self._cold, -shift.apart_rad_s)
        spent_s = 1e-9 * (now_ns - shift.start_ns)
        # the first sample after a filling has begun is still of a plain push
        self._motion.seeks_onset &= not self._was_begun
        self._was_begun = self._is_begun
        self._is_busy = self._motion.position(estimate.samples, spent_s, self._release.is_falling)
        if self._is_busy and not self._is_begun:
            self._take_onset()
        return super().command(now_ns, estimate, shift)

    def _prepare(self, now_ns: int, shift: ShiftContext) -> None:
        """Take what is known before the push: direction, rest, temperature, supply pressure."""
        own = self.parameters
        self._direction = int(shift.leg is Gear.FORWARD)
        filled_ns = shift.energised_ns[1]
        period_s = self.config.period_s
        rest_s = own.rest_s if filled_ns is None else 1e-9 * (now_ns - filled_ns) - period_s
        self._plain = rest_s < own.least_rest_s or shift.leg is Gear.NEUTRAL
        self._plain |= not own.closing_follows_current
        self._plain |= shift.attempt > 0 or not shift.steady
        self._waits = self.correction.plain > 0
        if self._waits and not self._plain:
            self.correction.plain -= 1
        if not (shift.agreed or own.speeds_agreed):
            self._waits = True
            self.correction.clocks.doubt(0, 1)
        heavier, variance = self.correction.heavier(self._direction)
        self._is_weighed = variance <= WEIGHED_WELL * WEIGHED_WELL
        sd = sqrt(variance + MESH_VARIANCE)
        likely, unlikely = heavier + LIKELY * sd, heavier + UNLIKELY * sd
        is_light = likely <= BEARS[CAREFUL] and unlikely <= BEARS_MORE[CAREFUL]
        self._careful = (CAREFUL, LATE) if is_light else ()
        level = max(likely - BEARS[STRONG], unlikely - BEARS_MORE[STRONG])
        softest = STRONG + max(ceil((level - LIGHTEST) / PER_LEVEL), 0)
        levels = (*range(softest, min(softest + 2, LATE)), *self._careful)
        self._strong = tuple(each for each in SOFTEST if each in levels)
        coil_k = REFERENCE_K if shift.coil_k is None else shift.coil_k
        warmer_k = min(max(coil_k, COLDEST_K), WARMEST_K) - REFERENCE_K
        self._close_s = own.close_s * exp(own.close_per_k * warmer_k)
        self._cold = exp((WARM_K - REFERENCE_K - warmer_k) / DRAG_FOLD_K)
        later_s = REST_S + self._close_s - REST_CLOSE_S - rest_s
        self._late_s = own.late_s + AIR_S * exp(min(later_s / AIR_FOLD_S, 3.0))
        self._coil = Coil(period_s, self._close_s)
        self._nominal_s = own.opens_later_s + own.open_s_per_k * (warmer_k + REFERENCE_K - TABLES_K)
        is_empty = self._late_s - own.late_s < AIRLESS_S
        self._motion.seeks_onset = is_empty and shift.leg is not Gear.NEUTRAL and shift.attempt == 0
        self._tables = self._library.near(own.supply_pa)
        self._plain |= abs(own.supply_pa - self._tables.nearest.supply_pa) > SUPPLY_PA

    def _delayed(self, onset_s: float | None) -> Delays:
        """Return how much later the valves open than those of the tables, by the onset of this push if it is known."""
        assert self._direction is not None
        nominal_s = self._nominal_s
        if onset_s is not None:
            onset_s -= nominal_s
        found = self.correction.clocks.delays(self._direction, onset_s)
        return found._replace(
            driving_s=found.driving_s + nominal_s, neutral_s=found.neutral_s + nominal_s
        )

    def _take_onset(self) -> None:
        """Expect the release as much later as the driving valve has opened."""
        self._is_fresh = True
        before_s = self._delays.driving_s
        self._delays = self._delayed(self._motion.onset_s)
        if (expected := self._expected) is not None:
            later_s = self._delays.driving_s - before_s
            self._expected = expected._replace(
                prior_s=expected.prior_s + later_s, used_s=expected.used_s + later_s
            )

    def decide(self, progress: Progress) -> Command:
        """Follow the programme that is expected to fit.

        Once its first filling has begun it is carried out, also without further reports: the release is
        late by then, and a push that goes on plainly would stop harder than one without a filling.
        """
        if progress.apart_rad_s is None:
            self._plain = True
        elif progress.apart_s > self._reported_s:
            self._reported_s = progress.apart_s
            self._note(progress, progress.apart_rad_s)
        if self._waits or self._expected is None:
            return PUSH
        step = round(progress.spent_s / self.config.period_s)
        if (self._plain or self._delays.is_doubted) and not self._is_begun:
            self._programme = None
            return PUSH
        if self._programme is None and not self._is_fresh:
            self._choose(self._expected, step)
        self._is_fresh = False
        programme = self._programme
        if programme is None:
            return PUSH
        held = self._held(programme, step)
        self._coil.step(held)
        if held <= 0.0:
            return PUSH
        self._is_begun = True
        return Command(True, True, held)

    def _held(self, programme: Programme, step: int) -> float:
        """Return the duty of the neutral valve for the coming step."""
        if self._filling >= len(programme.fillings):
            return 0.0
        start, end_s = programme.fillings[self._filling]
        full = self.config.duty
        if step <= start:
            return full if step == start else 0.0
        rest_s = end_s + self._delay_s - step * self.config.period_s
        held = self._coil.duty_until(rest_s, full)
        if held == 0.0:
            self._filling += 1
        return held

    def _choose(self, expected: Expected, step: int) -> None:
        """Take the programme that fits best if it begins at this step or the next one."""
        strengths = self._strengths(expected)
        if not strengths:
            return
        table = self._tables.nearest
        delay_s = self._delays.neutral_s
        target_s = expected.used_s - delay_s - self.parameters.late_s
        programme = table.row(target_s, step, strengths)
        if programme is None or step + 1 < programme.begin:
            return
        self._programme, self._target_s, self._delay_s = programme, target_s, delay_s

    def _strengths(self, expected: Expected) -> tuple[int, ...]:
        """Return which programmes are safe by what is known of the release and the meshing force.

        The softer ones first; another may still begin when it is too late for them. While the latest errors
        are doubtful, the reports of this shift alone have to tell the release that well.
        """
        careful, strong = expected.limits
        surprise = self.correction.surprise
        if surprise > SURPRISED or self._delays.driving_s > SLOWEST_S:
            return ()
        if expected.context.share < LIGHT_SHARE and not self._is_weighed:
            return ()
        variance = expected.variance
        if surprise > DOUBTED:
            variance = LONGEST_S if self._found is None else max(self._found[1], variance)
        if variance <= strong:
            return self._strong
        return self._careful if variance <= careful else ()

    def _note(self, progress: Progress, apart_rad_s: float) -> None:
        """Take a report: of the speeds before the push, or while the synchronizer works."""
        if progress.spent_s <= self.parameters.still_s:
            before_rad_s = self._last_rad_s
            jumps = before_rad_s is not None and abs(apart_rad_s - before_rad_s) > UNSTEADY_RAD_S
            if jumps or abs(progress.travelled_m) > OFF_M:
                self._plain = True
            self._last_rad_s = apart_rad_s
            self._sum_rad_s += apart_rad_s
            self._count += 1
            # in turn with choosing a programme, which is as much to do; neither when the onset was found
            self._is_turn ^= not self._is_busy
            expects = self._is_turn and self._programme is None
            self._is_fresh = expects or self._is_busy
            if expects and not self._is_busy:
                self._expect(self._sum_rad_s / self._count)
        elif self._expected is not None and self._release.released_s is None:
            before_rad_s = self._sum_rad_s / self._count
            if before_rad_s < 4.0 * REPORT_RAD_S:
                self._plain = True
                return
            at_s = progress.apart_s - self._expected.age_s
            if not self._release.speeds(at_s, apart_rad_s, before_rad_s):
                self._plain = True
            if self._programme is None:
                self._follow(self._expected, at_s, 1.0 - apart_rad_s / before_rad_s)

    def _expect(self, before_rad_s: float) -> None:
        """Compute when the plain push would be released, from the speeds before it."""
        assert self._direction is not None
        own = self.parameters
        tables = self._tables
        log_impulse = log(max(own.impulse_per_rad_s * before_rad_s, 1.0))
        release_s, slope_s, share = tables.release(log_impulse)
        noise = REPORT_RAD_S / max(before_rad_s, REPORT_RAD_S)
        scatter = sqrt(self._scatter + noise * noise / self._count)
        share = min(max(share, 0.0), 1.0)
        context = Context(self._direction, slope_s, share, self._drag, scatter)
        offset = self.correction.offset(context)
        prior_s = release_s + offset.later_s + self._delays.driving_s + self._late_s
        clocks = self.correction.clocks
        age_s, timing = own.speeds_age_s + clocks.age_s, TIMING_VARIANCE + clocks.variance
        careful_s = min(KNOWN[0] * slope_s, KNOWN_S[0])
        strong_s = min(KNOWN[1] * slope_s, KNOWN_S[1])
        limits = careful_s * careful_s, strong_s * strong_s
        self._expected = Expected(
            context, prior_s, prior_s, age_s, noise, timing, offset, offset.variance, limits
        )

    def _follow(self, expected: Expected, at_s: float, given: float) -> None:
        """Correct the expected release by the share of the impulse that has been `given`.

        Until the programme acts, the impulse grows as under the plain push. One table is enough:
        under another pressure the impulse of every time is larger by nearly the same factor.
        A share below a tenth says only that the release is later than a tenth would say.
        """
        if given >= 0.9:
            return
        is_measured, given = given > 0.1, max(given, 0.1)
        offset = expected.offset
        delay_s = self._delays.driving_s + self._late_s
        table = self._tables.nearest
        spent, rate_s = table.spent(at_s - delay_s)
        found_s = table.release(spent - log(given))[0] + delay_s
        noise = expected.noise / given
        timing = expected.timing / (rate_s * rate_s)
        slope_s = expected.context.slope_s
        variance = (noise * noise + timing) * slope_s * slope_s
        total = offset.variance + variance
        later_s = found_s - expected.prior_s
        unlikely = later_s * later_s > UNLIKELY_SQUARE * total
        if not is_measured and (later_s < 0.0 or not unlikely):
            return
        self._found = found_s, variance
        weight = offset.variance / total
        self._expected = expected._replace(
            used_s=expected.prior_s + weight * later_s,
            variance=LONGEST_S if unlikely else (1.0 - weight) * offset.variance,
        )

    def ended(self, now_ns: int, estimate: Estimate, confirmed: bool, healthy: bool) -> None:
        """Compare the release with what was expected, and pass the difference to the method."""
        correction, expected, release = self.correction, self._expected, self._release
        # speeds that still differ in gear are wrong, as is a position that confirmed it before
        slipped, self._has_ended = self._has_ended, True
        if release.is_open or slipped or not (confirmed and healthy):
            correction.plain = self.parameters.plain_pushes
            return
        correction.shifts = min(correction.shifts + 1, 0xFFFFFFFF)
        if self._direction is not None and self._motion.onset_s is not None:
            if self._is_begun:
                self._take_onset()
                expected = self._expected
            correction.clocks.began(self._direction, self._motion.onset_s - self._nominal_s)
        elif self._direction is not None and self._is_begun:
            correction.clocks.doubt(self._direction)
        if not (self._plain or self._delays.is_doubted or expected is None):
            self._learn(expected)

    def _learn(self, expected: Expected) -> None:
        """Learn from a push into a gear, if samples and speeds tell the same of its release."""
        correction, motion, programme = self.correction, self._motion, self._programme
        delayed_s = 0.0 if programme is None else programme.released_s - programme.plain_s
        left = motion.released_s(expected.used_s + delayed_s, programme is None)
        clocks = correction.clocks
        if left is None or self._release.released_s is None:
            return
        if motion.onset_s is not None:
            origin_s = motion.onset_s - self._delays.driving_s
        elif clocks.count > 0.0:
            origin_s = clocks.origin_s
        else:
            return
        left_s, variance = left
        if motion.onset_s is None and programme is not None:
            variance += EARLY_VARIANCE
        released_s = left_s - origin_s + START_S + self.parameters.late_s
        if not clocks.aged(self._release.released_s - released_s):
            correction.plain = self.parameters.plain_pushes
            return
        error_s = released_s - expected.used_s - delayed_s
        if programme is not None:
            error_s -= (programme.gain - 1.0) * (self._target_s - programme.plain_s)
            error_s /= programme.gain
        error_s += expected.used_s - expected.prior_s
        travel_s = 0.0 if motion.arrived_s is None else motion.arrived_s - left_s
        if programme is not None:
            error_s += max(travel_s - STALLED_S, 0.0)
        total = expected.offset.variance + variance
        limit_s = max(self.parameters.outlier_s, UNLIKELY * sqrt(total))
        is_outlier = abs(error_s) > limit_s
        correction.note(error_s, total, is_outlier)
        direction = expected.context.direction
        if is_outlier:
            correction.plain = self.parameters.plain_pushes
        else:
            correction.outliers[direction] = 0
        if not is_outlier or correction.is_evidence(direction, error_s, self.parameters.outliers):
            correction.learn(expected.context, error_s, motion.fastest_m_s, variance)
            if programme is None and motion.arrived_s is not None:
                self._weigh(expected, expected.prior_s + error_s, travel_s)

    def _weigh(self, expected: Expected, released_s: float, travel_s: float) -> None:
        """Find the meshing force from how long a plain push of a light shift took to arrive."""
        spent, _ = self._tables.nearest.spent(released_s - self._delays.driving_s - self._late_s)
        found = heavier_by(spent, travel_s, self.parameters.supply_pa)
        if found is not None:
            self.correction.resisted(expected.context.direction, *found)
