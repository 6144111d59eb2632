"""A firmware of one's own: the shipped one, whose push ends a fixed time after it began.

A valve closes D_fall (35 ms) after its command ends, and the stay needs about 30 ms for its travel: it
arrives as before. The air is not saved: the shipped blow after the confirmation opens the valve again.
"""

from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs, Outputs


class ShortPush(Firmware):
    """The shipped firmware with a limit on how long a valve is driven."""

    def __init__(self, config: FirmwareConfig) -> None:
        """Start with the settings of the scenario's table [controller]."""
        super().__init__(config)
        self.began_ns: int | None = None

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Return the messages of one period; the valves are off 30 ms after they were first on."""
        outputs = super().step(now_ns, inputs)
        valves = outputs.valves
        if not (valves.duty_b or valves.duty_n or valves.duty_f):
            self.began_ns = None
            return outputs
        if self.began_ns is None:
            self.began_ns = now_ns
        if now_ns - self.began_ns < 30_000_000:
            return outputs
        off = type(valves)(duty_b=0.0, duty_n=0.0, duty_f=0.0, target=valves.target)
        return outputs._replace(valves=off)
