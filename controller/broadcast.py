"""ETC1 and ETC2: what the control unit tells the truck of gears and shafts (SAE J1939-71)."""

from __future__ import annotations

from can_dbc.messages import DrivelineSpeeds, Etc1, Etc2, Gear
from controller.settings import BroadcastConfig, nanoseconds
from controller.shift import ShiftMachine


class Broadcast:
    """Makes ETC1 and ETC2 when they are due; gears are numbered as the settings say."""

    def __init__(self, config: BroadcastConfig, machine: ShiftMachine) -> None:
        self._machine = machine
        self._etc2_period_ns = nanoseconds(config.etc2_period_s)
        self._etc1_due_ns = self._etc2_due_ns = 0
        # an unknown gear has none of these
        self._numbers = {Gear.FORWARD: config.gear_forward, Gear.BACKWARD: config.gear_backward}
        self._numbers[Gear.NEUTRAL] = 0
        self._ratios = {Gear.FORWARD: config.ratio_forward, Gear.BACKWARD: config.ratio_backward}
        # the two characters of a range name the stroke, not the truck's direction
        self._ranges = {Gear.NEUTRAL: " N", Gear.FORWARD: " F", Gear.BACKWARD: " B"}

    def start(self, now_ns: int) -> None:
        """Make the first ones due now."""
        self._etc1_due_ns = self._etc2_due_ns = now_ns

    def etc1(self, now_ns: int, speeds: DrivelineSpeeds | None) -> Etc1 | None:
        """Return ETC1 every 10 ms, None in between."""
        if now_ns < self._etc1_due_ns:
            return None
        self._etc1_due_ns += 10_000_000
        current = self._machine.confirmed
        input_rad_s = output_rad_s = None
        if speeds is not None:
            ratio = self._ratios.get(speeds.referred, 0.0) or 1.0
            input_rad_s = _available(speeds.input_rad_s * ratio)
            output_rad_s = _available(speeds.output_rad_s)
        return Etc1(
            driveline_engaged=None if current is Gear.UNKNOWN else current is not Gear.NEUTRAL,
            shift_in_process=self._machine.in_process,
            output_shaft_rad_s=output_rad_s,
            input_shaft_rad_s=input_rad_s,
        )

    def etc2(self, now_ns: int) -> Etc2 | None:
        """Return ETC2 once a period of the settings, None in between."""
        if now_ns < self._etc2_due_ns:
            return None
        self._etc2_due_ns += self._etc2_period_ns
        machine = self._machine
        current = machine.confirmed
        selected = machine.final if machine.in_process else current
        return Etc2(
            selected_gear=self._numbers.get(selected),
            gear_ratio=self._ratios.get(current, 0.0) or None,
            current_gear=self._numbers.get(current),
            requested_range=self._ranges.get(selected),
            current_range=self._ranges.get(current),
        )


def _available(speed_rad_s: float) -> float | None:
    """Return a shaft speed that ETC1 can carry, None for another."""
    return speed_rad_s if 0.0 <= speed_rad_s <= 841.0 else None
