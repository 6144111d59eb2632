"""A controller of the gear shift with python-can and cantools alone, on a free-running bus.

    python free_controller.py opc4.dbc opc4local bench 10
    python free_controller.py opc4.dbc socketcan vcan0 10

It steps every 10 ms by its own clock for the given time (s), or until the bus is gone. Its firmware is the simplest that
shifts: push until the sensor shows the gear in three samples, blow for 150 ms, vent.
"""

import contextlib
import sys
import time

import can
import cantools

NEUTRAL, BACKWARD, FORWARD, UNKNOWN = range(4)
INIT, IDLE, PUSH, CONFIRM, BLOW = range(5)
PERIOD_S, BLOW_S = 0.01, 0.15


def crc8_2f(data, data_id):
    """AUTOSAR E2E profile 2, over bytes 1 to 7 and the data id of the counter."""
    crc = 0xFF
    for byte in (*data[1:], data_id):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


class Controller:
    def __init__(self, database, bus):
        self.bus, self.counter = bus, 0
        self.messages = {m.name: m for m in database.messages}
        self.names = {m.frame_id: m.name for m in database.messages}
        self.wanted = self.target = self.confirmed = self.gear = UNKNOWN
        self.state, self.samples, self.position_m, self.blow_end = INIT, 0, 0.0, 0.0

    def data_id(self, name, counter):
        return bytes.fromhex(self.messages[name].dbc.attributes["E2EDataIdList"].value)[counter]

    def send(self, name, **signals):
        message = self.messages[name]
        values = {s.name: 0 for s in message.signals} | signals | {"Counter": self.counter % 16}
        data = bytearray(message.encode(values, strict=False, padding=True))
        data[0] = crc8_2f(data, self.data_id(name, self.counter % 16))
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data))

    def receive(self, frame):
        name, data = self.names.get(frame.arbitration_id), frame.data
        if name not in ("ShiftRequest", "PositionPulse") or len(data) != 8:
            return
        if data[0] != crc8_2f(data, self.data_id(name, data[1] & 15)):
            return
        values = self.messages[name].decode(bytes(data), decode_choices=False)
        if name == "ShiftRequest":
            self.wanted = values["TargetGear"]
            return
        warm = 1.0 + 0.0012 * (values["CoilTemperature"] - 293.15)
        x = self.position_m = (1e-6 * values["PulseDuration"] / warm - 0.0009) / 0.022
        gear = BACKWARD if x > 0.0119 else FORWARD if x < -0.0119 else UNKNOWN
        gear = NEUTRAL if abs(x) < 0.001 else gear
        self.samples = self.samples + 1 if gear == self.gear else 1
        self.gear = gear

    def step(self, now):
        settled = self.gear if self.samples >= 3 else UNKNOWN
        blown = self.state == BLOW and now >= self.blow_end
        if blown or (self.state == INIT and settled != UNKNOWN):
            self.state, self.confirmed = IDLE, settled
        elif self.state == IDLE and self.wanted not in (UNKNOWN, self.confirmed):
            direct = NEUTRAL in (self.wanted, self.confirmed)
            self.state, self.target = PUSH, self.wanted if direct else NEUTRAL
            self.confirmed = UNKNOWN
        elif self.state == PUSH and settled == self.target:
            self.state, self.confirmed, self.blow_end = BLOW, self.target, now + BLOW_S
        push, blow = self.state == PUSH, self.state == BLOW
        chamber = {BACKWARD: 0, NEUTRAL: 1}.get(self.target, 2)
        duty = {"Duty" + "BNF"[chamber]: 98} if push else {}
        left = max(0.0, 1e3 * (self.blow_end - now)) if blow else 0
        self.send("ValveCommand", TargetGear=self.target if push else UNKNOWN, **duty)
        room = chamber if blow else 3
        self.send("SafetyBlow", BlowChamber=room, BlowActive=blow, BlowRemaining=left)
        um, gear = 1e6 * self.position_m, self.confirmed
        self.send("ControllerStatus", State=self.state, ConfirmedGear=gear, PositionEstimate=um)
        self.counter += 1


with can.Bus(interface=sys.argv[2], channel=sys.argv[3], ignore_config=True) as bus:
    unit = Controller(cantools.database.load_file(sys.argv[1]), bus)
    tick = time.monotonic()
    end = tick + float(sys.argv[4])
    with contextlib.suppress(can.CanOperationError):
        while tick < end:
            while (left := tick - time.monotonic()) > 0:
                if (received := bus.recv(left)) is not None:
                    unit.receive(received)
            unit.step(tick)
            tick += PERIOD_S
