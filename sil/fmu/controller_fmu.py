"""The firmware as a co-simulation unit: sensor pulses, request and speeds in, commands out.

Runs inside the importing tool's Python, where this package must be installed; settings.json next to
this file is the scenario it was exported from. The firmware steps at every multiple of its period
inside a communication step, its end excluded, with the inputs of that step; a new sample_index
announces a new pulse.
"""

from __future__ import annotations

from typing import Any

from pythonfmu3 import DefaultExperiment, Float64, Fmi3Slave, Int32


class Opc4Controller(Fmi3Slave):
    """The OPC4 firmware at its own period."""

    author = "opc4-sil"
    description = "OPC4 firmware: position from pulses, filter, shift state machine, strategy."

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        from controller.firmware import Firmware
        from sil.firmware.frame_steps import FrameSteps
        from sil.firmware.load import firmware_node
        from sil.fmu.slave import declare, prepare
        from sil.simulation.build import gear_of

        scenario = prepare(self).scenario
        self.firmware: Any = Firmware(scenario.controller)
        if scenario.firmware:
            self.firmware = FrameSteps(firmware_node(scenario.firmware, scenario.controller))
        self.period_ns = scenario.controller.period_ns
        self.default_experiment = DefaultExperiment(
            0.0, scenario.duration_s, scenario.controller.period_s
        )
        self._last_index = -1
        shafts = {"input_rad_s": 0.0, "output_rad_s": 0.0}
        numbers_in = {"pulse_s": 0.0, "coil_temperature_k": 293.15, **shafts}
        about_in = {
            "sample_index": "number of the latest pulse, 0 to 255; -1 before the first",
            "request": "gear: 0 neutral, 1 backward, 2 forward",
        }
        codes_in = {"sample_index": -1, "request": int(gear_of(scenario.initial_gear))}
        about_out = {
            "blow_chamber": "0 B, 1 N, 2 F, 3 none",
            "state": "of the shift state machine",
            "confirmed": "gear: 0 neutral, 1 backward, 2 forward, 3 unknown",
            "faults": "bits of the reported faults",
        }
        codes_out = dict.fromkeys(about_out, 0) | {"blow_chamber": 3, "confirmed": 3}
        declare(self, Float64, numbers_in, output=False)
        declare(self, Int32, codes_in, output=False, descriptions=about_in)
        numbers_out = ("duty_b", "duty_n", "duty_f", "blow_remaining_s", "estimate_m")
        declare(self, Float64, dict.fromkeys(numbers_out, 0.0), output=True)
        declare(self, Int32, codes_out, output=True, descriptions=about_out)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Step the firmware at each of its ticks within this communication step."""
        begin_ns, end_ns = round(current_time * 1e9), round((current_time + step_size) * 1e9)
        tick_ns = -(-begin_ns // self.period_ns) * self.period_ns
        while tick_ns < end_ns:
            self._tick(tick_ns)
            tick_ns += self.period_ns
        self.time = current_time + step_size
        return True

    def _tick(self, now_ns: int) -> None:
        from can_dbc.messages import DrivelineSpeeds, E2eState, Gear, PositionPulse, ShiftRequest
        from controller.firmware import Inputs

        pulses: tuple[PositionPulse, ...] = ()
        if self.sample_index >= 0 and self.sample_index != self._last_index:
            self._last_index = self.sample_index
            pulses = (PositionPulse(self.pulse_s, self.coil_temperature_k, self.sample_index),)
        state = E2eState.VALID
        out = self.firmware.step(
            now_ns,
            Inputs(
                pulses=pulses,
                request=ShiftRequest(Gear(self.request)),
                speeds=DrivelineSpeeds(self.input_rad_s, self.output_rad_s),
                position_state=state if self._last_index >= 0 else E2eState.INIT,
                request_state=state,
                speeds_state=state,
            ),
        )
        for name in ("duty_b", "duty_n", "duty_f"):
            setattr(self, name, getattr(out.valves, name))
        self.blow_chamber = int(out.blow.chamber)
        self.blow_remaining_s = out.blow.remaining_s if out.blow.active else 0.0
        self.estimate_m = out.status.estimate_m
        self.state = int(out.status.state)
        self.confirmed = int(out.status.confirmed)
        self.faults = int(out.status.faults)
