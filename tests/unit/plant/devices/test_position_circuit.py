"""Circuit of the inductive sensor: static instants, readings, each fault."""

from __future__ import annotations

import msgspec
import pytest

from can_dbc.errors import InputError
from plant.devices.position_circuit import PositionCircuit, Reading, SensorConfig, SensorFault
from plant.devices.sensors import InductiveSensor

MS = 1_000_000
SENSOR = InductiveSensor(0.0009, 0.022, 0.0012, 293.15, 1e-6)
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
        assert reading is not None
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
    reports = pulses_with(window("stuck"))
    assert reports == [true_pulse(i) for i in (0, 1, 2, 2, 2, 2, 6, 7)]
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
    reports = pulses_with(SensorFault(kind="delayed", late=3))
    assert reports == [healthy[0]] * 3 + healthy[:5]
