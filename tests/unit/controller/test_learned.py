"""The strategy that learns: what it does with speeds, without them, and after faults."""

from __future__ import annotations

from math import exp, log
from typing import Any

import pytest
from msgspec import structs

from can_dbc.messages import Chamber, Gear
from controller.clocks import DOUBTED, SEEN, SETTLED, Clocks, Onsets
from controller.config import FirmwareConfig, create_strategy
from controller.learning import Sensitivities
from controller.position import Estimate, Sample
from controller.programmes import CAREFUL, LATE, STRONG, library
from controller.strategies import Duties, ShiftContext, one_chamber
from controller.strategies.learned import DRAG_FOLD_K, WARM_K, Learned
from controller.strategies.motion import BLOCK_M, CLEAR_M, START_S, Motion
from plant.devices.valve import Valve, ValveTiming

MS = 1_000_000
TABLE = library().near(9e5).nearest
PER_RAD_S = 0.25 / 0.09
PUSHES = one_chamber(Chamber.B, 0.98)


ONSET_S = 0.03
"""When the samples of these pushes say that the stay began to move."""
LATE_S = 0.0004
MESH = 14
"""Of `Sensitivities.values`, the variance of the meshing force backward."""


def learned(**parameters: Any) -> Learned:
    made = {"closing_follows_current": True, "speeds_agreed": True, "open_s_per_k": 0.0}
    strategy = create_strategy(
        FirmwareConfig(strategy="learned", strategy_parameters=made | parameters)
    )
    assert isinstance(strategy, Learned)
    return strategy


def practised(**parameters: Any) -> Learned:
    """Return a unit that knows its friction, valves, speeds and teeth well, and that they are nominal."""
    made = learned(**parameters)
    made.correction.values[2] = 0.0
    if made.parameters.method == "sensitivities":
        for at in (3, 7, 11):
            made.correction.values[at] *= 0.04
        made.correction.values[MESH] = made.correction.values[MESH + 2] = 0.02**2
    both = Onsets(state=SEEN), Onsets(state=SEEN)
    made.correction.clocks = Clocks(0.0, 0.0006**2, 0.0, ONSET_S, SETTLED, both)
    return made


def begun_m(taken_s: float, supply_pa: float) -> float:
    """Return the way of the stay in a sample so long after its onset."""
    motion = Motion(0.01, 0.01285, supply_pa)

    def off_s(way_m: float) -> float:
        return abs(motion._taken(way_m) - taken_s)

    return min((1e-5 * k for k in range(1, 600)), key=off_s)


def left_m(taken_s: float, expected_s: float, is_plain: bool) -> float:
    """Return the way beyond the block in a sample so long after the release, at most to the gear."""
    motion = Motion(0.01, 0.01285, 8.5e5)

    def off_s(beyond_m: float) -> float:
        motion.left = taken_s, beyond_m
        found = motion.released_s(expected_s, is_plain)
        assert found is not None
        return abs(found[0])

    return min((1e-5 * k for k in range(1, 640)), key=off_s)


def push(
    strategy: Learned,
    impulse_n_s: float,
    *,
    friction: float = 1.0,
    until_ms: int = 350,
    lost_ms: int = 10_000,
    report_ms: int = 10,
    healthy: bool = True,
    confirmed: bool = True,
    first_rad_s: float = 0.0,
    rest_m: float = 0.0,
    begin_ms: int = 60,
    stuck_at: float = 0.0,
    onset_s: float = ONSET_S,
    **shift: Any,
) -> list[Duties]:
    """Push with a synchronizer that takes `friction` times the impulse that its speeds call for.

    The speeds fall as the table has it from `begin_ms` on, to the share `stuck_at` of their difference,
    and are lost from `lost_ms` on. The samples of the position have no age: the stay moves from `onset_s`
    on, is blocked, and leaves the block with the release.
    """
    strategy.reset()
    before_rad_s, needed_n_s = impulse_n_s / PER_RAD_S, friction * impulse_n_s + 1e-9
    start_ns, left_s = 10**9, TABLE.release(log(needed_n_s))[0] + ONSET_S - START_S
    given: list[Duties] = []
    first = Gear.BACKWARD, Gear.BACKWARD, Chamber.B, Chamber.N, start_ns, 0, (None, None, None)
    context = ShiftContext(*first)._replace(**{"coil_k": 293.15} | shift)
    for ms in range(0, until_ms, 10):
        acted = strategy._programme
        at_s, delayed_s = 1e-3 * ms - 0.0065 - LATE_S, 0.0
        if acted is not None and at_s > 0.01 * acted.begin:
            delayed_s = acted.released_s - acted.plain_s
            at_s = max(at_s - delayed_s, 0.01 * acted.begin)
        share = exp(TABLE.spent(at_s)[0]) / needed_n_s if ms > begin_ms else 0.0
        apart_rad_s = before_rad_s * max(stuck_at, 1.0 - share) if ms < lost_ms else None
        if ms == 0 and apart_rad_s is not None:
            apart_rad_s += first_rad_s
        after_s = 1e-3 * ms - left_s - delayed_s
        begun_s, supply_pa = 1e-3 * ms - onset_s, strategy.parameters.supply_pa
        way_m = begun_m(begun_s, supply_pa) if begun_s > 0.0 else 0.0
        if ms > 50:
            way_m = BLOCK_M
        if after_s > 0.0:
            beyond_m = left_m(after_s, left_s + delayed_s, acted is None)
            way_m += beyond_m if beyond_m > CLEAR_M else 0.0
        raw_m = rest_m + way_m
        position_m = rest_m if ms < 60 else raw_m  # the filter is late
        estimate = Estimate(True, raw_m, position_m, 0.0, (Sample(raw_m, position_m, 0.0),))
        now_ns = start_ns + ms * MS
        if ms % report_ms == 0 or apart_rad_s is None:
            context = context._replace(apart_rad_s=apart_rad_s, apart_ns=now_ns)
        given.append(strategy.command(now_ns, estimate, context))
    strategy.ended(start_ns + until_ms * MS, estimate, confirmed, healthy)
    return given


def plain(given: list[Duties]) -> bool:
    return set(given) == {PUSHES}


@pytest.mark.parametrize(
    ("supply_bar", "acts"), [(7.7, False), (7.9, True), (8.9, True), (9.1, True), (9.3, False)]
)
def test_a_supply_far_from_the_tables_makes_the_push_plain(supply_bar: float, acts: bool) -> None:
    strategy = practised(supply_pa=1e5 * supply_bar)
    assert plain(push(strategy, 70.0)) != acts


@pytest.mark.parametrize("impulse_n_s", [22.0, 65.0, 140.0, 170.0, 240.0])
def test_it_fills_neutral_by_the_programme_and_goes_on_pushing(impulse_n_s: float) -> None:
    strategy = practised()
    given = push(strategy, impulse_n_s)
    assert not plain(given)
    assert given[-1] == PUSHES
    assert all((duties.b, duties.f) == (0.98, 0.0) for duties in given)
    programme = strategy._programme
    assert programme is not None
    release_s, slope_s = TABLE.release(log(impulse_n_s))
    assert abs(programme.plain_s - release_s) < 0.05 * slope_s + 0.001
    duties = [each.n for each in given]
    begins = [k for k, duty in enumerate(duties) if duty > 0.0 and duties[k - 1] == 0.0]
    assert begins == [filling.start for filling in programme.fillings]
    assert all(duties[k] == 0.98 for k in begins)
    # what the plant's valve makes of them
    valve = Valve(ValveTiming(8 * MS, 35 * MS, 0.33, 0.35, True, 0.004, 0.0293))
    for k, duty in enumerate(duties):
        valve.command(10 * MS * k, duty)
    closes_s = [1e-9 * at_ns for at_ns, position in valve.moves(10**9) if position == 0.0]
    assert closes_s == pytest.approx([each.end_s for each in programme.fillings], abs=0.001)
    assert strategy.correction.shifts == 1
    assert not strategy.is_committed, "the last filling has ended"


def test_valves_with_a_constant_closing_delay_have_no_programmes() -> None:
    assert plain(push(practised(closing_follows_current=False), 140.0))


def test_friction_is_learned_and_the_programme_moves() -> None:
    """A new unit pushes plainly; with friction, drag and delay known it acts, later by the friction."""
    strategy = learned()
    assert plain(push(strategy, 55.0, friction=1.08))
    for k in range(40):
        push(strategy, (45.0, 70.0, 140.0)[k % 3], friction=1.08)
    friction, _, drag = strategy.correction.values[:3]
    cold = exp((WARM_K - 293.15) / DRAG_FOLD_K)
    assert friction - cold * drag == pytest.approx(log(1.08), abs=0.015)
    learnt = push(strategy, 55.0, friction=1.08)
    assert not plain(learnt)
    assert learnt != push(practised(), 55.0)
    again = learned()
    again.recall(strategy.memory)
    one, other = (push(unit, 55.0, friction=1.08) for unit in (again, strategy))
    assert [each.n for each in one] == pytest.approx([each.n for each in other], abs=1e-6)


def test_the_speeds_of_this_shift_correct_what_is_expected() -> None:
    """A large impulse, 4 % more friction: only a part is left to learn, the programme is later."""
    for impulse_n_s, friction, least_s in ((200.0, 1.04, 0.002), (200.0, 1.0, -0.001)):
        strategy = practised()
        push(strategy, impulse_n_s, friction=friction)
        expected = strategy._expected
        assert expected is not None
        assert least_s < expected.used_s - expected.prior_s < least_s + 0.002
        assert expected.variance < 0.5 * expected.offset.variance
    assert push(practised(), 40.0, friction=1.01) == push(practised(), 40.0), (
        "too early to be noticed"
    )


@pytest.mark.parametrize(
    "changed",
    [
        {"leg": Gear.NEUTRAL, "charged": Chamber.B},
        {"attempt": 1},
        {"energised_ns": (None, 10**9 - 100 * MS, None)},
        {"steady": False},
    ],
    ids=["neutral", "again", "air in N", "speeds have jumped"],
)
def test_the_plain_push(changed: dict[str, Any]) -> None:
    strategy = practised()
    memory = strategy.memory
    assert plain(push(strategy, 140.0, **changed))
    assert strategy.correction.values == practised().correction.values
    assert strategy.memory != memory, "the shift counts"


def test_filled_before_power_on() -> None:
    assert plain(push(practised(rest_s=0.19), 140.0))
    assert not plain(push(practised(rest_s=0.2), 140.0))


def test_air_left_in_neutral_delays_the_release_that_is_expected() -> None:
    """Filled 0.2 s ago it delays by 1 ms; less by e-folds later, more behind valves that close late."""
    expected_s = []
    for rest_s, coil_k in ((60.0, 293.15), (0.2, 293.15), (0.2265, 293.15), (0.2, 280.0)):
        strategy = practised(rest_s=rest_s)
        push(strategy, 140.0, coil_k=coil_k)
        assert strategy._expected is not None
        expected_s.append(strategy._late_s - strategy.parameters.late_s)
    assert expected_s[:3] == pytest.approx([0.0, 0.001, 0.001 / 2.71828], abs=1e-8)
    assert 0.00105 < expected_s[3] < 0.0012
    slow = practised(rest_s=0.2, close_s=0.036)
    push(slow, 140.0, coil_k=293.15)
    assert slow._late_s - slow.parameters.late_s == pytest.approx(0.001 * exp(1.0 / 26.5))
    later = practised(rest_s=0.2)
    push(later, 140.0)
    empty = practised()
    push(empty, 140.0)
    assert later._expected is not None and empty._expected is not None
    assert later._expected.prior_s - empty._expected.prior_s == pytest.approx(0.001, abs=1e-5)


def test_a_blow_of_this_unit_ends_a_step_after_it_was_commanded_last() -> None:
    for blown_ms, acts in ((200, False), (210, True)):
        filled = (None, 10**9 - blown_ms * MS, None)
        assert plain(push(practised(), 140.0, energised_ns=filled)) != acts


def test_without_speeds_and_without_a_fall_of_them() -> None:
    assert plain(push(practised(), 140.0, lost_ms=0))
    assert plain(push(practised(), 1e-6))
    assert plain(push(practised(), 0.0))
    assert plain(push(practised(still_s=0.065), 5.0)), "gone between two reports"
    strategy = practised()
    assert plain(push(strategy, 5.0))
    assert strategy.correction.values == practised().correction.values


@pytest.mark.parametrize("impulse_n_s", [45.0, 100.0])
def test_a_synchronizer_that_works_far_too_little_teaches_nothing(impulse_n_s: float) -> None:
    heavy = practised()
    push(heavy, impulse_n_s, friction=6.0)
    assert heavy.correction.plain == 2
    assert heavy.correction.values == practised().correction.values


def test_speeds_that_jump_before_the_push_make_it_plain() -> None:
    assert not plain(push(practised(), 100.0, first_rad_s=2.0))
    assert plain(push(practised(), 100.0, first_rad_s=5.0))


def test_speeds_that_differ_in_a_gear_make_the_next_two_pushes_plain() -> None:
    strategy = practised()
    push(strategy, 140.0, until_ms=150)
    assert [plain(push(strategy, 100.0)) for _ in range(3)] == [True, True, False]


def test_reports_at_every_second_step_are_enough() -> None:
    strategy = practised()
    assert not plain(push(strategy, 140.0, report_ms=20))
    assert strategy.correction.values != practised().correction.values


def test_beyond_the_tables_it_pushes() -> None:
    assert plain(push(practised(), 400.0))


@pytest.mark.parametrize("end", [{"healthy": False}, {"confirmed": False}])
def test_after_a_fault_two_pushes_are_plain_and_nothing_is_practised(end: dict[str, bool]) -> None:
    strategy = practised()
    assert not plain(push(strategy, 60.0, friction=1.05, **end))
    assert strategy.correction.values == practised().correction.values
    again = practised()
    again.recall(strategy.memory)  # a power-off does not help
    for _ in range(2):
        assert plain(push(again, 60.0))
    assert not plain(push(again, 60.0))


def weighed(mesh: float) -> Learned:
    """Return a unit that has found a meshing force in its gear backward again and again."""
    made = practised()
    for _ in range(20):
        made.correction.resisted(0, mesh, 1e-5)
    return made


def test_the_heavier_a_gear_is_known_to_be_the_more_its_programmes_bear() -> None:
    """The levels are for 1 to 19 % more meshing force; beyond the last one the push is plain."""
    levels, given = [], []
    for mesh in (-0.3, -0.05, 0.0, 0.08, 0.16, 0.25):
        strategy = weighed(mesh)
        given.append([push(strategy, n_s) for n_s in (22.0, 65.0, 95.0, 150.0, 230.0)])
        levels.append(strategy._strong)
    usually = STRONG, STRONG + 1, CAREFUL, LATE
    heavily = STRONG + 2, CAREFUL, STRONG + 3, LATE
    assert levels == [usually, usually, usually, heavily, (STRONG + 4,), ()]
    lightest, lighter, usual, heavy, heavier, heaviest = given
    assert lightest == lighter == usual != heavy != heavier
    assert not any(plain(each) for each in [*usual, *heavy])
    assert not all(plain(each) for each in heavier)
    assert all(plain(each) for each in heaviest)


def test_a_light_shift_weighs_the_teeth_before_it_is_softened() -> None:
    unknown = practised()
    unknown.correction.values[MESH] = 0.05**2
    assert plain(push(unknown, 22.0))
    assert not plain(push(unknown, 65.0))
    assert not plain(push(practised(), 22.0))


def test_a_programme_that_is_known_too_late_gives_way_to_one_of_the_next_level() -> None:
    strategy = weighed(0.0)
    push(strategy, 140.0)
    assert strategy._expected is not None
    rows, heavier = TABLE.rows[STRONG], TABLE.rows[STRONG + 1]
    at = next(k for k in range(10, len(rows) - 1) if heavier[k].begin > rows[k].begin > 0
              and max(rows[k + 1].begin, rows[k - 1].begin) <= rows[k].begin)  # fmt: skip
    used_s = rows[at].plain_s + strategy.parameters.late_s + 1e-5
    expected = strategy._expected._replace(used_s=used_s, variance=0.0)
    step = heavier[at].begin
    strategy._programme = None
    strategy._choose(expected, step)
    assert strategy._programme == heavier[at]


def test_the_context_is_where_the_impulse_is_in_the_tables() -> None:
    strategy = practised()
    for impulse_n_s, share in ((14.0, 0.0), (63.7, 0.5), (290.0, 1.0)):
        push(strategy, impulse_n_s)
        assert strategy._expected is not None
        assert strategy._expected.context.share == pytest.approx(share, abs=0.005)


@pytest.mark.parametrize(("travel_s", "sign"), [(0.0135, 0), (0.016, -1), (0.08, 1)])
def test_a_light_push_weighs_the_teeth(travel_s: float, sign: int) -> None:
    strategy = practised()
    push(strategy, 17.0)
    expected = strategy._expected
    assert expected is not None
    strategy.correction.values[MESH] = before = 0.05**2
    strategy._weigh(expected, TABLE.release(log(16.0))[0], travel_s)
    heavier, variance = strategy.correction.heavier(0)
    assert (heavier > 0.0) - (heavier < 0.0) == sign
    assert (variance < 0.9 * before) == bool(sign)
    strategy._weigh(expected, TABLE.release(log(60.0))[0], travel_s)
    assert strategy.correction.heavier(0) == (heavier, variance), "not a light one"


def test_an_outlier_teaches_nothing_and_three_do() -> None:
    strategy = practised()
    for _ in range(2):
        push(strategy, 35.0, friction=1.9)
        assert strategy.correction.values == practised().correction.values
    push(strategy, 35.0, friction=1.9)
    assert strategy.correction.values != practised().correction.values


def test_outliers_in_a_row_are_evidence_those_between_good_pushes_are_not() -> None:
    strategy = practised()
    for _ in range(4):
        push(strategy, 35.0, friction=1.9)
        push(strategy, 35.0)
    assert strategy.correction.values[3] < practised().correction.fresh[3] / 2.0


def test_errors_larger_than_expected_make_it_plain_until_they_are_not() -> None:
    """Shifts in turn 8 % harder and lighter than expected, by a unit that expects 2 %; power-offs between."""
    strategy, memory, surprised = practised(), b"", []
    for k in range(40):
        strategy.correction.values[:12] = practised().correction.values[:12]
        given = push(strategy, 140.0, friction=1.08 if k % 2 else 0.92)
        surprised.append(plain(given))
        memory = strategy.memory
        strategy = learned()
        strategy.recall(memory)
    assert not any(surprised[:4])
    assert all(surprised[20:])
    for _ in range(30):
        strategy.correction.values[:12] = practised().correction.values[:12]
        given = push(strategy, 140.0)
    assert not plain(given)


@pytest.mark.parametrize(
    ("surprise", "without_report", "with_report"),
    [
        (1.0, True, True),
        (1.49, True, True),
        (1.51, False, True),
        (1.89, False, True),
        (1.91, False, False),
    ],
)
def test_with_doubtful_errors_a_programme_needs_a_report_of_its_own_shift(
    surprise: float, without_report: bool, with_report: bool
) -> None:
    """A programme for 35 N s has to begin before the reports tell its share, one for 60 N s does not."""
    for impulse_n_s, acts in ((35.0, without_report), (60.0, with_report)):
        strategy = practised()
        strategy.correction.surprise = surprise
        assert plain(push(strategy, impulse_n_s)) != acts


@pytest.mark.parametrize(("surprise", "acts"), [(1.0, True), (1.51, False)])
def test_with_doubtful_errors_reports_of_unknown_age_are_not_enough(
    surprise: float, acts: bool
) -> None:
    strategy = practised()
    strategy.correction.clocks.variance = 0.01**2
    strategy.correction.surprise = surprise
    assert plain(push(strategy, 200.0)) != acts
    assert strategy._found is not None


def test_a_push_that_ends_before_the_release_teaches_nothing() -> None:
    strategy = practised()
    for until_ms in (60, 120):
        push(strategy, 140.0, until_ms=until_ms)
        assert strategy.correction.values == practised().correction.values


def test_temperature_moves_the_last_duty_of_a_filling() -> None:
    """A warm valve closes sooner: it is held longer or with more current. Nonsense is clamped."""
    warm, cold = push(practised(), 140.0, coil_k=340.0), push(practised(), 140.0, coil_k=265.0)
    assert warm != cold
    assert push(practised(), 140.0, coil_k=1e6) == push(practised(), 140.0, coil_k=343.15)
    assert push(practised(), 140.0, coil_k=None) == push(practised(), 140.0)


@pytest.mark.parametrize("method", ["map", "iterative", "search"])
def test_every_method_runs(method: str) -> None:
    strategy = learned(method=method)
    for _ in range(5):
        push(strategy, 60.0, friction=1.05)
    assert strategy.correction.values != learned(method=method).correction.values


@pytest.mark.parametrize("later_s", [-0.001, 0.0005, 0.003, 0.005])
@pytest.mark.parametrize("is_block", [True, False])
def test_late_valves_take_a_later_programme_and_slower_ones_none(
    later_s: float, is_block: bool
) -> None:
    """If the valve of the other gear is late, too, neutral's is taken to be as late, else to be in time."""
    strategy = practised()
    backward, forward = strategy.correction.clocks.directions
    backward.latest_s, forward.latest_s = later_s, later_s if is_block else 0.0
    is_slow = later_s > 0.0045
    assert plain(push(strategy, 65.0, onset_s=ONSET_S + later_s)) == is_slow
    neutral_s = later_s if is_block or later_s < 0.0 else 0.0
    assert strategy._delays.neutral_s == pytest.approx(neutral_s, abs=5e-5)
    assert strategy._expected is not None
    assert strategy._expected.prior_s == pytest.approx(
        TABLE.release(log(65.0))[0] + later_s + LATE_S, abs=1e-4
    )
    if not is_slow:
        assert strategy._programme is not None
        assert strategy._delay_s == strategy._delays.neutral_s
        assert strategy._expected.used_s - strategy._target_s - LATE_S == pytest.approx(
            neutral_s, abs=1e-4
        )
        assert strategy._programme.plain_s == pytest.approx(
            strategy._target_s, abs=1.01 * TABLE.step_s
        )


@pytest.mark.parametrize(("later_s", "acts"), [(0.0014, True), (0.0016, False), (-0.0016, False)])
def test_an_onset_that_jumps_makes_the_push_plain_and_the_next_one_confirms_it(
    later_s: float, acts: bool
) -> None:
    strategy = practised()
    friction = list(strategy.correction.values)
    late = {"onset_s": ONSET_S + later_s}
    assert plain(push(strategy, 140.0, friction=1.05, **late)) != acts
    assert (strategy.correction.values == friction) != acts, "in doubt it teaches nothing"
    other = {"leg": Gear.FORWARD, "final": Gear.FORWARD, "charged": Chamber.F}
    again = learned()
    again.recall(strategy.memory)  # a power-off does not help
    given = push(again, 140.0, **other, **late)  # also of the other gear
    assert any(duties.n > 0.0 for duties in given) == acts
    for each in ({}, other, {}):
        given = push(strategy, 140.0, **each, **late)
    assert not plain(given)


def test_after_a_push_that_hid_its_onset_the_next_one_waits_for_it() -> None:
    """A programme that begins before the stay moves would not see a valve that was exchanged."""
    strategy = practised()
    backward, forward = strategy.correction.clocks.directions
    begins = []
    for hides in (True, False, True):
        given = push(strategy, 40.0)
        begins.append(next(k for k, duties in enumerate(given) if duties.n > 0.0))
        assert (strategy._motion.onset_s is None) == hides
        assert (backward.state, forward.state) == (DOUBTED if hides else SEEN, SEEN)
    first, waiting, last = begins
    assert first == last < 4 < waiting


def test_a_release_after_a_hidden_onset_counts_less(monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[float] = []
    plain_learn = Sensitivities.learn

    def noting(self: Sensitivities, *arguments: Any) -> None:
        counted.append(arguments[3])
        plain_learn(self, *arguments)

    monkeypatch.setattr(Sensitivities, "learn", noting)
    strategy = practised()
    for hides in (True, False):
        push(strategy, 40.0)
        assert (strategy._motion.onset_s is None) == hides
    hidden, seen = counted
    assert hidden == pytest.approx(seen + 0.0012**2, abs=0.0006**2)


def test_a_new_unit_that_has_seen_no_onset_yet_cannot_place_a_release() -> None:
    """As after a blow on neutral, whose air delays the onset."""
    strategy = learned(rest_s=0.21)
    push(strategy, 140.0)
    assert strategy._motion.left is not None and strategy._motion.onset_s is None
    assert strategy.correction.values == learned().correction.values
    strategy = practised(rest_s=0.21)
    push(strategy, 140.0, friction=1.02)
    assert strategy._motion.onset_s is None
    assert strategy.correction.values != practised().correction.values


def test_after_power_on_the_valves_may_be_others() -> None:
    """The first push is plain, and a light one until the onset of its direction is known."""
    strategy = practised(speeds_agreed=False)
    backward, forward = strategy.correction.clocks.directions
    assert plain(push(strategy, 22.0))
    assert (backward.state, forward.state) == (SEEN, DOUBTED)
    other = {"leg": Gear.FORWARD, "final": Gear.FORWARD, "charged": Chamber.F, "agreed": True}
    assert all(duties.n == 0.0 for duties in push(strategy, 22.0, **other))
    assert any(duties.n > 0.0 for duties in push(strategy, 22.0, **other))
    assert not plain(push(strategy, 22.0, agreed=True))


def test_samples_that_tell_another_release_than_the_speeds_teach_nothing() -> None:
    strategy = practised()
    push(strategy, 140.0)
    assert strategy.correction.plain == 0
    strategy = practised()
    friction = list(strategy.correction.values)
    strategy.correction.clocks.age_s = -0.015  # of the speeds, ever since
    push(strategy, 140.0)
    assert strategy.correction.values == friction
    assert strategy.correction.plain == 2


def test_the_release_is_learned_from_samples_alone() -> None:
    """To a half of a millisecond, in plain pushes and by programmes, whatever the age of the speeds."""
    for impulse_n_s in (25.0, 45.0, 70.0, 140.0):
        for strategy in (practised(), practised(speeds_agreed=False)):
            strategy.correction.clocks.variance = 0.003**2
            strategy.parameters = structs.replace(strategy.parameters, speeds_age_s=0.004)
            before = strategy.correction.values[0]
            push(strategy, impulse_n_s)
            _, slope_s = TABLE.release(log(impulse_n_s))
            assert abs(strategy.correction.values[0] - before) * slope_s < 0.0005
            assert strategy.correction.clocks.age_s == pytest.approx(0.0025, abs=0.0015)
