"""The firmware's promises under arbitrary inputs and under random faults in the loop."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.messages import (
    DrivelineSpeeds,
    E2eState,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.settings import BlowConfig, FilterConfig, SensorConfig, ShiftConfig
from tests.support.toy_actuator import AT, MS, Rig, Row, Stay, asks, check_invariants, pulse_s

GEARS = list(Gear)
WANTED_M = {**AT, Gear.UNKNOWN: 0.0}
PLACES_M: list[float | None] = [0.0, 0.01285, -0.01285, 0.002, 0.006, -0.006, 0.0115, -0.0115, 0.02]

CONFIGS = st.builds(
    FirmwareConfig,
    period_s=st.sampled_from([0.01, 0.0025, 0.003, 0.02]),
    sensor=st.builds(SensorConfig, period_s=st.sampled_from([0.01, 0.0025])),
    filter=st.builds(FilterConfig, enabled=st.booleans(), order=st.sampled_from([1, 3, 6])),
    blow=st.builds(
        BlowConfig,
        duration_s=st.sampled_from([0.15, 0.03, 0.0]),
        cut=st.sampled_from(["none", "sync", "confirmation"]),
    ),
    shift=st.builds(
        ShiftConfig,
        push_timeout_s=st.sampled_from([1.0, 0.15]),
        retries=st.integers(0, 2),
        reversal_settle_s=st.sampled_from([0.12, 0.0]),
        init_settle_s=st.sampled_from([0.04, 0.0]),
        wait_for_sync=st.booleans(),
        sync_wait_s=st.sampled_from([1.0, 0.05]),
        no_motion_s=st.sampled_from([0.4, 0.06]),
    ),
)

CHANNEL = st.sampled_from([E2eState.VALID] * 14 + [E2eState.INVALID, E2eState.INIT])

SCENES = st.lists(
    st.tuples(
        st.integers(1, 25),  # steps
        st.sampled_from([None] * 6 + PLACES_M),  # where the stay goes; None: where it is wanted
        st.sampled_from([0.004, 0.004, 0.0, 0.0003]),  # how fast, m per sample; 0: at once
        st.sampled_from(GEARS),
        st.sampled_from([None, (0.0, 0.0), (9.0, 0.0), (-5.0, 1e4)]),
        CHANNEL,
        CHANNEL,
        CHANNEL,
        st.sampled_from([1, 1, 1, 1, 1, 1, 0, 2, 40]),  # pulses per step
    ),
    min_size=2,
    max_size=25,
)
Scene = tuple[
    int, float | None, float, Gear, tuple[float, float] | None, E2eState, E2eState, E2eState, int
]

WAKE: Scene = (20, None, 0.0, Gear.NEUTRAL, None, E2eState.VALID, E2eState.VALID, E2eState.VALID, 1)


def play(config: FirmwareConfig, scenes: list[Scene]) -> list[Row]:
    """Run the firmware on scenes, none of which heeds what it commands."""
    firmware = Firmware(config)
    rows: list[Row] = []
    position_m = 0.0
    index = now_ns = 0
    for steps, place_m, pace_m, gear, speeds, s_pos, s_req, s_speed, count in scenes:
        goal_m = WANTED_M[gear] if place_m is None else place_m
        for _ in range(steps):
            pulses = []
            for _ in range(count):
                step_m = goal_m - position_m
                if pace_m:
                    step_m = min(max(step_m, -pace_m), pace_m)
                position_m += step_m
                index += 1
                pulses.append(PositionPulse(pulse_s(position_m), 293.15, index % 256))
            inputs = Inputs(
                tuple(pulses),
                ShiftRequest(gear),
                None if speeds is None else DrivelineSpeeds(*speeds),
                s_pos,
                s_req,
                s_speed,
            )
            rows.append(Row(now_ns, firmware.step(now_ns, inputs), position_m))
            now_ns += config.period_ns
    return rows


def check_scenes(config: FirmwareConfig, scenes: list[Scene], visited: Counter[ShiftState]) -> None:
    rows = play(config, scenes)
    visited.update({row.state for row in rows})
    check_invariants(rows, config)


def test_promises_hold_whatever_comes_in() -> None:
    visited: Counter[ShiftState] = Counter()

    @given(config=CONFIGS, scenes=st.one_of(SCENES, SCENES.map(lambda scenes: [WAKE, *scenes])))
    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    def run(config: FirmwareConfig, scenes: list[Scene]) -> None:
        check_scenes(config, scenes, visited)

    run()
    for state in ShiftState:  # the inputs reach every state
        assert visited[state] >= 10, f"{state.name}: {visited[state]}"


@pytest.mark.slow
@given(config=CONFIGS, scenes=SCENES)
@settings(max_examples=3000, deadline=None)
def test_promises_hold_at_length(config: FirmwareConfig, scenes: list[Scene]) -> None:
    check_scenes(config, scenes, Counter())


@st.composite
def troubled(draw: st.DrawFn) -> Rig:
    """A rig with a restless driver, a stay that may be blocked, a sensor that fails at times."""
    gears = st.sampled_from([Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD])
    requests = [(100.0 + 10.0 * draw(st.integers(0, 150)), draw(gears)) for _ in range(8)]
    start_m = draw(st.sampled_from([0.0, 0.01285, -0.01285]))
    fault = draw(st.sampled_from(["none", "none", "lost", "stuck", "spikes", "silent"]))
    begin_ns = draw(st.integers(10, 150)) * 10 * MS
    end_ns = begin_ns + draw(st.integers(1, 60)) * 10 * MS
    first_pulse: list[PositionPulse] = []

    def pulse(now_ns: int, real: PositionPulse) -> PositionPulse | None:
        if not begin_ns <= now_ns < end_ns:
            first_pulse[:] = [real]
            return real
        if fault == "silent":
            return None
        if fault == "stuck" and first_pulse:
            return replace(first_pulse[0], sample_index=real.sample_index)
        if fault == "spikes" and real.sample_index % 5 == 0:
            return replace(real, pulse_s=0.003)
        return real

    def position_state(now_ns: int) -> E2eState:
        lost = fault == "lost" and begin_ns <= now_ns < end_ns
        return E2eState.INVALID if lost else E2eState.VALID

    return Rig(
        stay=Stay(position_m=start_m, block_m=draw(st.sampled_from([None, None, 0.006]))),
        request=asks((0.0, Gear.NEUTRAL), *sorted(requests)),
        speeds=lambda now_ns: DrivelineSpeeds(0.0, 0.0),
        pulse=pulse,
        position_state=position_state,
    )


def check_truth(rig: Rig) -> None:
    """What is reported as confirmed is so, whatever one fault of the sensor there is."""
    rig.run(2200)
    check_invariants(rig.rows)
    for row in rig.rows:
        confirmed = row.out.status.confirmed
        if confirmed is not Gear.UNKNOWN:
            assert abs(row.position_m - AT[confirmed]) <= 0.0026


@given(rig=troubled())
@settings(max_examples=40, deadline=None, derandomize=True, database=None)
def test_no_gear_is_reported_that_is_not_engaged(rig: Rig) -> None:
    check_truth(rig)


@pytest.mark.slow
@given(rig=troubled())
@settings(max_examples=1500, deadline=None)
def test_no_gear_is_reported_at_length(rig: Rig) -> None:
    check_truth(rig)
