"""A firmware of your own, derived from the shipped one: change what you want to try.

As it stands it behaves as the shipped firmware. `opc4 run lab_n_b --firmware own.py` runs it.
"""

from controller.config import FirmwareConfig
from controller.firmware import Firmware as ShippedFirmware
from controller.firmware import Inputs, Outputs

MAX_DUTY = 1.0  # of any valve; try 0.3: below 0.33 no valve opens


class Firmware(ShippedFirmware):
    """The shipped firmware with a limit on the duties of its valves."""

    def __init__(self, config: FirmwareConfig) -> None:
        """Start with the settings of the scenario's table [controller]."""
        super().__init__(config)

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Return the messages of one period, called every controller.period_s of simulated time.

        inputs.pulses holds the position pulses since the last step; inputs.request what the driver
        asks for. Read no clock: now_ns is the time in ns.
        """
        outputs = super().step(now_ns, inputs)
        valves = outputs.valves
        limited = type(valves)(
            duty_b=min(valves.duty_b, MAX_DUTY),
            duty_n=min(valves.duty_n, MAX_DUTY),
            duty_f=min(valves.duty_f, MAX_DUTY),
            target=valves.target,
        )
        return outputs._replace(valves=limited)
