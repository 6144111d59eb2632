"""What each fault of thermometer and shaft speeds makes of the reports."""

from __future__ import annotations

from typing import Any

import msgspec

from plant.devices.signal_faults import SpeedFault, SpeedSensors, TemperatureFault, Thermometer

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
