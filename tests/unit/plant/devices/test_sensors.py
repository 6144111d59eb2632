"""Sensors, and the circuit of the inductive one: pulse, filtered chain, generators, what each fault makes of the reports."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from importlib.resources import files
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from plant.devices.position_circuit import PositionCircuit, Reading, SensorConfig, SensorFault
from plant.devices.sensors import (
    Floats,
    InductiveSensor,
    InternalChain,
    low_passed,
    named_generator,
)
from plant.devices.signal_faults import SpeedFault, SpeedSensors, TemperatureFault, Thermometer

SENSOR = InductiveSensor(0.0009, 0.022, 0.0012, 293.15, 1e-6)
CHAIN = InternalChain(SENSOR, SENSOR, 0.01, 0.0041, 6, 22.0, 293.15, 293.15)
RAW = replace(CHAIN, filter_order=0)


class Nominal:
    """Values of the nominal set, read without its loader."""

    def __init__(self) -> None:
        text = files("plant").joinpath("parameters/nominal.toml").read_text()
        self.sections = tomllib.loads(text)

    def value(self, path: str) -> float:
        section, name = path.split(".")
        return float(self.sections[section][name]["value"])


def test_pulse_at_neutral_and_at_the_reference_temperature_is_0_9_ms() -> None:
    assert SENSOR.pulse_s(0.0, 293.15) == pytest.approx(0.9e-3, abs=1e-12)
    assert SENSOR.pulse_s(0.01285, 293.15) == pytest.approx(1183e-6, abs=1e-12)
    assert SENSOR.measurement_offset_ns == 450_000


@settings(deadline=None)
@given(st.floats(-0.014, 0.014), st.floats(233.0, 413.0))
def test_conversion_undoes_the_pulse_within_half_a_tick(
    position: float, temperature: float
) -> None:
    pulse = SENSOR.pulse_s(position, temperature)
    half_tick_m = 0.5 * 1e-6 / 0.022 / (1 + 0.0012 * (temperature - 293.15))
    assert abs(float(SENSOR.position_m(pulse, temperature)) - position) <= half_tick_m * (1 + 1e-6)
    assert SENSOR.ticks(SENSOR.duration_s(position, temperature)) == round(pulse / 1e-6)


def test_a_coil_warmer_than_believed_reads_further_out() -> None:
    error = float(SENSOR.position_m(SENSOR.duration_s(0.005, 303.15), 293.15)) - 0.005
    assert error == pytest.approx(0.0012 * 10 * (0.0009 + 0.022 * 0.005) / 0.022)


def test_filter_is_settled_at_its_first_sample() -> None:
    still = low_passed(np.full(30, 0.0123), 6, 22.0, 100.0)
    np.testing.assert_allclose(still, 0.0123, rtol=1e-12)


@pytest.mark.parametrize(
    ("order", "cutoff", "text"),
    [(13, 22.0, "butter_order"), (0, 22.0, "butter_order"), (6, 50.0, "butter_fc")],
)
def test_impossible_filters_are_refused(order: int, cutoff: float, text: str) -> None:
    with pytest.raises(InputError, match=text):
        low_passed(np.zeros(3), order, cutoff, 100.0)


@pytest.mark.parametrize(
    ("path", "value"), [("t_mid", 0.0), ("slope", 0.0), ("period", 0.0), ("latency", -1.0)]
)
def test_impossible_parameters_are_named(path: str, value: float) -> None:
    nominal = Nominal()
    nominal.sections["position_sensor"][path]["value"] = value
    with pytest.raises(InputError, match=f"position_sensor.{path}: "):
        InternalChain.from_parameters(nominal)


def reported_m(
    chain: InternalChain, time_s: Floats, position_m: Floats, phase_s: float = 0.0
) -> Floats:
    """What the chain reports of a position recorded at `time_s`, straight between records."""
    end_s = float(time_s[-1])
    at_s = chain.measurement_instants_ns(end_s, phase_s) * 1e-9
    measured = np.interp(at_s, time_s, position_m)
    return chain.held_m(time_s, chain.ticks_s(end_s, phase_s), measured)


def mean_lag_s(chain: InternalChain, speed_m_s: float = 0.02) -> float:
    """Lag behind a ramp once settled, averaged over the sampling phase."""
    time_s = np.arange(8001) * 1e-4
    position = speed_m_s * np.maximum(time_s - 0.1, 0.0)
    late = time_s > 0.5
    lags = []
    for phase in np.arange(20) * 5e-4:
        reported = reported_m(chain, time_s, position, float(phase))
        lags.append(np.mean(position[late] - reported[late]) / speed_m_s)
    return float(np.mean(lags))


def test_lag_without_filter_is_10_ms_whatever_the_phase() -> None:
    mean_duration = 0.0009 + 0.022 * 0.02 * 0.55  # t8V half-way through the window
    expected = 0.0041 + mean_duration - 0.00045 + 0.005
    assert mean_lag_s(RAW) == pytest.approx(expected, abs=1e-4)
    assert mean_lag_s(RAW) == pytest.approx(0.010, abs=0.5e-3)


def test_filter_adds_its_group_delay_at_rest() -> None:
    w = np.tan(np.pi * 22.0 / 100.0)
    damping = sum(2 * np.sin(np.pi * (2 * k + 1) / 12) for k in range(3))
    delay = damping / w * 0.01 / 2  # sum of the sections' delays d/w in steps of T/2
    assert mean_lag_s(CHAIN) - mean_lag_s(RAW) == pytest.approx(delay, abs=2e-5)
    assert 0.03 < mean_lag_s(CHAIN) < 0.045


def test_recorded_stroke_of_an_independent_solver() -> None:
    """Backward to neutral at 9 bar: its positions at the measurement instants, its column."""
    measured = np.array(
        [0.01285] * 4 + [0.0126412, 0.01033835, 0.00225285] + [0.0] * 6, dtype=np.float64
    )
    expected = {
        0.0350: 0.0128636, 0.0353: 0.0128600, 0.0550: 0.0127977, 0.0551: 0.0123462,
        0.0649: 0.0123462, 0.0650: 0.0106282, 0.0850: 0.0019046, 0.0950: -0.0014101,
        0.1051: -0.0014658,
    }  # fmt: skip
    tick_s = CHAIN.ticks_s(0.115)
    assert len(tick_s) == len(measured)
    reported = CHAIN.held_m(np.array(list(expected)), tick_s, measured)
    np.testing.assert_allclose(reported, list(expected.values()), atol=1.5e-7)


def test_instants_of_the_chain() -> None:
    assert list(CHAIN.ticks_s(0.025, 0.0037)) == pytest.approx([-0.0063, 0.0037, 0.0137, 0.0237])
    assert list(CHAIN.measurement_instants_ns(0.025, 0.0037)) == [0, 4150000, 14150000, 24150000]
    assert list(CHAIN.measurement_instants_ns(0.02, 0.0)) == [0, 450000, 10450000]
    assert list(CHAIN.measurement_instants_ns(0.0, 0.013)) == [0]


def test_faults_of_the_chain_are_differences_between_sensor_and_calibration() -> None:
    time_s = np.arange(1000) * 1e-4
    position = np.full(1000, 0.008)
    gain = replace(RAW, sensor=replace(SENSOR, slope_s_m=0.022 * 1.05))
    assert reported_m(gain, time_s, position)[-1] == pytest.approx(0.0084, abs=3e-5)
    warm = replace(RAW, coil_temperature_k=313.15)
    shift = 0.0012 * 20 * (0.0009 + 0.022 * 0.008) / 0.022
    assert reported_m(warm, time_s, position)[-1] == pytest.approx(0.008 + shift, abs=3e-5)


def test_nominal_set_gives_this_chain() -> None:
    assert InternalChain.from_parameters(Nominal()) == CHAIN


def test_named_generators_are_reproducible_and_independent() -> None:
    draw = named_generator(1, "a", 2).normal(size=4)
    np.testing.assert_array_equal(draw, named_generator(1, "a", 2).normal(size=4))
    for other in (named_generator(2, "a", 2), named_generator(1, "a2"), named_generator(1, "a", 3)):
        assert np.all(draw != other.normal(size=4))


MS = 1_000_000


def temperatures(**fault: Any) -> list[float]:
    sensor = Thermometer([msgspec.convert({"start_s": 0.03, **fault}, TemperatureFault)], 1)
    return [sensor.reading_k(10 * k * MS, 300.0) for k in range(12)]


def speeds(**fault: Any) -> list[tuple[float, float] | None]:
    sensors = SpeedSensors([msgspec.convert({"start_s": 0.03, **fault}, SpeedFault)], 1)
    return [sensors.report(10 * k * MS, float(k), 80.0) for k in range(12)]


HEALTHY: list[tuple[float, float] | None] = [(float(k), 80.0) for k in range(12)]


def test_thermometer() -> None:
    assert temperatures(kind="off") == [300.0] * 3 + [200.0] * 9
    assert temperatures(kind="stuck", value_k=350.0) == [300.0] * 3 + [350.0] * 9
    assert (
        temperatures(kind="wrong", offset_k=-20.0, end_s=0.05)
        == [300.0] * 3 + [280.0, 280.0] + [300.0] * 7
    )
    garbage = temperatures(kind="garbage")
    assert garbage[:3] == [300.0] * 3 and len(set(garbage[3:])) == 9
    assert all(200.0 <= t <= 450.0 for t in garbage)
    assert set(temperatures(kind="intermittent")[3:]) == {200.0, 300.0}


def test_speeds() -> None:
    assert speeds(kind="off") == HEALTHY[:3] + [None] * 9
    assert speeds(kind="off", end_s=0.05) == HEALTHY[:3] + [None] * 2 + HEALTHY[5:]
    assert speeds(kind="stuck") == HEALTHY[:3] + [(3.0, 80.0)] * 9
    assert speeds(kind="wrong", offset_rad_s=5.0)[3:5] == [(8.0, 80.0), (9.0, 80.0)]
    assert [s is None for s in speeds(kind="slow", every=3)[3:]] == [False, True, True] * 3
    assert speeds(kind="delayed", late=2)[3:8] == [HEALTHY[k] for k in (3, 3, 3, 4, 5)]
    assert None in speeds(kind="intermittent")[3:]
    assert all(s is not None and 0.0 <= s[0] <= 200.0 for s in speeds(kind="garbage")[3:])


def test_measured_speeds_saturate() -> None:
    sensors = SpeedSensors([SpeedFault(kind="wrong", offset_rad_s=300.0)], 1)
    assert sensors.report(0, 900.0, 80.0) == (1000.0, 80.0)


REACH = 0.0135


def circuit(
    *faults: SensorFault, config: SensorConfig | None = None, seed: int = 1
) -> PositionCircuit:
    return PositionCircuit(config or SensorConfig(), SENSOR, REACH, faults, seed)


def readings(unit: PositionCircuit, count: int, position_m: float = 0.004) -> list[Reading | None]:
    for i in range(count):
        unit.measure(position_m + i * 1e-4)
    return [unit.report() for _ in range(count)]


def test_default_pulse_starts_5_ms_before_a_tick_and_is_reported_in_time() -> None:
    unit = circuit()
    assert unit.measurement_instants_ns(30 * MS) == [5_450_000, 15_450_000, 25_450_000]
    assert unit.next_report_ns == 6_500_000
    fast = circuit(config=SensorConfig(period_s=0.0025))
    assert fast.measurement_instants_ns(6 * MS) == [450_000, 2_950_000, 5_450_000]


def test_phase_and_delay_move_the_instants() -> None:
    unit = circuit(config=SensorConfig(phase_s=0.0123, delay_s=0.025, capture_s=0.002))
    assert unit.measurement_instants_ns(15 * MS) == [2_750_000, 12_750_000]
    assert unit.next_report_ns == 2_300_000 + 27 * MS
    unit.measure(0.0)
    unit.measure(0.001)
    unit.measure(0.002)
    first = unit.report()
    assert first == Reading(pytest.approx(0.0009), 293.15, 0)
    assert unit.next_report_ns == 2_300_000 + 37 * MS
    assert unit.measurement_instants_ns(15 * MS) == []


def test_readings_tell_position_temperature_and_number() -> None:
    config = SensorConfig(coil_temperature_k=323.15, measured_temperature_k=303.15)
    reports = readings(circuit(config=config), 300)
    assert [r.sample_index for r in reports if r] == [i % 256 for i in range(300)]
    for i, reading in enumerate(reports):
        assert reading.temperature_k == 303.15
        assert reading.pulse_s == SENSOR.pulse_s(0.004 + i * 1e-4, 323.15)


def test_noise_is_seeded_and_has_its_size() -> None:
    config = SensorConfig(noise_sd_s=5e-6)
    pulses = [r.pulse_s for r in readings(circuit(config=config), 400) if r]
    again = [r.pulse_s for r in readings(circuit(config=config), 400) if r]
    other = [r.pulse_s for r in readings(circuit(config=config, seed=2), 400) if r]
    assert pulses == again != other
    errors = [p - SENSOR.pulse_s(0.004 + i * 1e-4, 293.15) for i, p in enumerate(pulses)]
    spread = (sum(e * e for e in errors) / len(errors)) ** 0.5
    assert spread == pytest.approx(5e-6, rel=0.15)


# --- faults: pulses 3, 4, 5 start at 35, 45, 55 ms ------------------------------------------------
def window(kind: str, **more: object) -> SensorFault:
    return msgspec.convert({"kind": kind, "start_s": 0.035, "end_s": 0.065, **more}, SensorFault)


def true_pulse(i: int) -> float:
    return SENSOR.pulse_s(0.004 + i * 1e-4, 293.15)


def pulses_with(*faults: SensorFault, count: int = 8) -> list[float | None]:
    return [r.pulse_s if r else None for r in readings(circuit(*faults), count)]


def test_stuck_repeats_the_last_report_or_a_given_one() -> None:
    assert pulses_with(window("stuck")) == [true_pulse(i) for i in (0, 1, 2, 2, 2, 2, 6, 7)]
    assert pulses_with(window("stuck", pulse_s=0.001))[2:7] == [
        true_pulse(2), 0.001, 0.001, 0.001, true_pulse(6),
    ]  # fmt: skip
    from_the_start = SensorFault(kind="stuck")
    assert pulses_with(from_the_start) == [true_pulse(0)] * 8


def test_off_reports_nothing_and_the_numbers_go_on() -> None:
    reports = readings(circuit(window("off")), 8)
    assert [r.sample_index if r else None for r in reports] == [0, 1, 2, None, None, None, 6, 7]


def test_slow_reports_every_nth() -> None:
    reports = pulses_with(SensorFault(kind="slow", start_s=0.035, every=3), count=12)
    assert [p is not None for p in reports] == [True] * 3 + [True, False, False] * 3


def test_intermittent_loses_its_share_reproducibly() -> None:
    fault = SensorFault(kind="intermittent", probability=0.3)
    reports = pulses_with(fault, count=1000)
    assert sum(p is None for p in reports) == pytest.approx(300, abs=45)
    assert reports == pulses_with(fault, count=1000)
    assert pulses_with(SensorFault(kind="intermittent", probability=1.0)) == [None] * 8
    assert None not in pulses_with(SensorFault(kind="intermittent", probability=0.0))


def test_garbage_is_uniform_and_on_the_timers_grid() -> None:
    reports = pulses_with(SensorFault(kind="garbage", garbage_s=0.004), count=1000)
    assert all(p is not None and 0.0 <= p <= 0.004 for p in reports)
    assert all(abs(p / 1e-6 - round(p / 1e-6)) < 1e-6 for p in reports if p is not None)
    assert sum(p for p in reports if p) / 1000 == pytest.approx(0.002, rel=0.06)
    assert reports != pulses_with(
        SensorFault(kind="off", end_s=0.0), SensorFault(kind="garbage", garbage_s=0.004), count=1000
    )


def test_faults_combine_in_order() -> None:
    reports = pulses_with(window("stuck", pulse_s=0.001), window("slow", every=2))
    assert reports[3:6] == [0.001, None, 0.001]


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(InputError, match=r"sensor.capture_s: 0.001; expected"):
        circuit(config=SensorConfig(capture_s=0.001))
    with pytest.raises(InputError, match=r"sensor.period_s: 0.001; expected"):
        circuit(config=SensorConfig(period_s=0.001))
    with pytest.raises(InputError, match="450 K"):
        circuit(config=SensorConfig(capture_s=0.00125, coil_temperature_k=450.0))


def test_a_wrong_circuit_adds_its_offset() -> None:
    healthy, reports = pulses_with(), pulses_with(SensorFault(kind="wrong", offset_s=5e-5))
    assert [f - h for f, h in zip(reports, healthy, strict=True)] == pytest.approx([5e-5] * 8)  # type: ignore[operator]


def test_a_delayed_circuit_gives_what_was() -> None:
    healthy = pulses_with()
    assert pulses_with(SensorFault(kind="delayed", late=3)) == [healthy[0]] * 3 + healthy[:5]
