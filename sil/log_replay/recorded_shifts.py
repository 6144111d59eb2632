"""Commanded shifts of a log: commands as they reached the valves, pulses, speeds, supply."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray

from can_dbc.codec import can_id_of, decode, encode
from can_dbc.e2e import Protector
from can_dbc.errors import CodecError, InputError
from can_dbc.frame import Frame, split_id
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    Air1,
    Chamber,
    DrivelineSpeeds,
    Gear,
    PositionPulse,
    SafetyBlow,
    ValveCommand,
)
from plant.devices.position_circuit import SensorConfig
from plant.devices.sensors import InductiveSensor
from plant.devices.valve_driver import Duties, ValveDriver, ValveDriverConfig
from plant.parameters import ParameterSet
from sil.files.quantity import counted
from sil.j1939.mapping import Meaning, SignalMapping
from sil.log_replay.recorded_frames import Arrival, RecordedFrames, is_intact
from sil.log_replay.truck_log import SHAFT_SPEEDS
from sil.logs import LogFrame, LogReader, open_log
from sil.shifts.cutter import CommandedShifts

Floats = NDArray[np.float64]

NEEDED: Final = {can_id_of(kind): kind for kind in (ValveCommand, PositionPulse)}
"""The messages without which there is no shift, by identifier."""
LEAD_S: Final = 0.05
"""Simulated time of a shift before its first command."""
NO_BLOW: Final = SafetyBlow(Chamber.NONE, False, 0.0)
GIVEN_UP_S: Final = 0.35
"""Time after which a commanded gear that was not reached is a failed shift, not a change of mind."""
BETWEEN_GEARS: Final = "began with the stay between gears"
"""What a shift did that cannot be simulated, and is none of a healthy truck."""
AIR1_PGN: Final = split_id(can_id_of(Air1)).pgn


@dataclass(frozen=True)
class RecordedShift:
    """One shift as recorded; times in s from LEAD_S before its first command.

    start, end: gears, N, B or F. commands: (time, chamber 0 to 2, duty). time_s, position_m: [n], the
    instants that the pulses measured, if nothing delays them, and the positions that they report.
    difference_rad_s: input minus output speed before the gear is engaged. supply_pa: absolute. Both
    are NaN if the log has none. failed: it did not reach the gear commanded, which is its `end` then.
    off_s: when the valve of each chamber was last switched off before; minus infinity if never.
    """

    source: str
    begin_s: float
    start: str
    end: str
    commands: tuple[tuple[float, int, float], ...]
    time_s: Floats
    position_m: Floats
    difference_rad_s: float
    supply_pa: float
    failed: bool = False
    off_s: tuple[float, ...] = (-math.inf,) * 3


@dataclass
class _Episode:
    """Commands of a shift, and the frames of pulses and speeds; ns.

    off_ns: when the valve of each chamber was last switched off before it, None if never.
    """

    begin_ns: int
    off_ns: tuple[int | None, ...]
    frames: dict[type, list[tuple[int, Frame]]]
    targets: list[tuple[int, Gear]] = field(default_factory=list)
    commands: list[tuple[int, int, float]] = field(default_factory=list)

    def s(self, time_ns: int) -> float:
        """Return a time as those of the recorded shift."""
        return (time_ns - self.begin_ns + round(LEAD_S * NS_PER_S)) / NS_PER_S


class ShiftReader:
    """Reads commanded shifts from the frames of one log, as they come.

    skipped: shifts that cannot be used, by the reason.
    """

    def __init__(self, source: str, parameters: ParameterSet) -> None:
        value = parameters.value
        self._source = source
        self._sensor = InductiveSensor.from_parameters(parameters)
        self._stroke_m = value("length.stroke")
        self._atmosphere_pa = value("gas.P_atm")
        self._duty_open = value("valve.duty_open")
        self._driver = ValveDriver(
            ValveDriverConfig(), value("valve.duty_nominal"), self._duty_open
        )
        self._duties: Duties = self._driver.duties
        self._off_ns: list[int | None] = [None] * 3
        self._cutter = CommandedShifts()
        self._episode: _Episode | None = None
        self._recent: dict[type, deque[tuple[int, Frame]]] = {
            PositionPulse: deque(maxlen=40),
            DrivelineSpeeds: deque(maxlen=8),
        }
        self._supply_pa = float("nan")
        self.skipped = self._cutter.skipped
        self.frames: Counter[type] = Counter()
        self._no_blow = Protector(SafetyBlow)

    def take(self, arrival: Arrival) -> RecordedShift | None:
        """Take a frame; return the shift that it completes."""
        time_ns, kind, frame = arrival
        if kind in (ValveCommand, SafetyBlow):
            received = [(time_ns, frame)]
            # after 20 commands the log is taken as one without any SafetyBlow
            silent = not self.frames[SafetyBlow] and self.frames[ValveCommand] >= 20
            if silent and kind is ValveCommand:
                received.append((time_ns, self._no_blow.protect(NO_BLOW)))
            for at_ns, duties in self._driver.advance(time_ns, received):
                if (ended := self._command(at_ns, duties)) is not None:
                    return ended
        elif kind in (PositionPulse, DrivelineSpeeds):
            self._recent[kind].append((time_ns, frame))
            if self._episode is not None:
                self._episode.frames[kind].append((time_ns, frame))
        elif kind is None and split_id(frame.can_id).pgn == AIR1_PGN:
            with suppress(CodecError):
                message = decode(Frame(can_id_of(Air1), frame.data))
                if isinstance(message, Air1) and message.supply_gauge_pa is not None:
                    self._supply_pa = message.supply_gauge_pa + self._atmosphere_pa
        if kind is not None:
            self.frames[kind] += 1
        return self._closed(self._cutter.pass_time(time_ns))

    def finish(self) -> RecordedShift | None:
        """Return the shift that the end of the log completes."""
        pulses = self._recent[PositionPulse]
        return self._closed(self._cutter.finish(pulses[-1][0])) if pulses else None

    def _command(self, at_ns: int, duties: Duties) -> RecordedShift | None:
        """Take new duties; return the shift that a command out of its gear ends."""
        before, self._duties = self._duties, duties
        energised = max(duties) >= self._duty_open
        ended = self._closed(self._cutter.command(at_ns, energised, self._is_in_gear))
        if self._episode is None and self._cutter.begin_ns is not None:
            recent = {kind: list(frames) for kind, frames in self._recent.items()}
            self._episode = _Episode(at_ns, tuple(self._off_ns), recent)
        if self._episode is not None:
            targets = self._episode.targets
            if energised and self._driver.target not in {target for _, target in targets[-1:]}:
                targets.append((at_ns, self._driver.target))
            self._episode.commands += [
                (at_ns, chamber, duty)
                for chamber, (duty, old) in enumerate(zip(duties, before, strict=True))
                if duty != old
            ]
        for chamber, (duty, old) in enumerate(zip(duties, before, strict=True)):
            if duty < self._duty_open <= old:
                self._off_ns[chamber] = at_ns
        return ended

    def _is_in_gear(self) -> bool:
        """Whether the latest pulse is one of an engaged gear."""
        pulses = self._recent[PositionPulse]
        message = decode(pulses[-1][1]) if pulses else None
        if not isinstance(message, PositionPulse):
            return False
        position = self._sensor.position_m(message.pulse_s, message.coil_temperature_k)
        return self._gear(float(position)) in ("B", "F")

    def _closed(self, begin_ns: int | None) -> RecordedShift | None:
        """Return the shift that is over, if one is and it can be used."""
        if self._cutter.begin_ns is not None and begin_ns is None:
            return None
        episode, self._episode = self._episode, None
        if episode is None or begin_ns is None:
            return None
        shift = self._shift(episode)
        if isinstance(shift, str):
            self.skipped[shift] += 1
            return None
        return shift

    def _shift(self, episode: _Episode) -> RecordedShift | str:
        """Return the shift of an episode, or why there is none."""
        readings = [
            (episode.s(time), message.pulse_s, message.coil_temperature_k, message.sample_index)
            for time, frame in episode.frames[PositionPulse]
            if is_intact(PositionPulse, frame)
            and isinstance(message := decode(frame), PositionPulse)
        ]
        if len(readings) < 12:
            return "with too few pulses"
        arrived, pulse, kelvin, number = np.array(readings, dtype=np.float64).T
        index = np.concatenate([[0.0], np.cumsum(np.diff(number) % 256)])
        if index[-1] < 1.0:
            return "without numbered pulses"
        config = SensorConfig()
        period = float(np.polyfit(index, arrived, 1)[0])
        if abs(period / config.period_s - 1.0) < 0.002:  # what a few late frames can do
            period = config.period_s
        begun = float(np.min(arrived - period * index)) + period * index
        if begun[-1] < arrived[-1] - 0.5 * period:  # more than 255 pulses lost, or another period
            return "with a gap in the pulses"
        # a pulse's frame lasts 0.26 ms at 500 kbit/s; another bit rate is part of the delay's prior
        measured_s = begun - 0.00026 - config.capture_s + 0.5 * self._sensor.t_mid_s
        warmth = 1.0 + self._sensor.temp_coeff_1_k * (kelvin - self._sensor.t_ref_k)
        position = (pulse / warmth - self._sensor.t_mid_s) / self._sensor.slope_s_m
        before = position[measured_s < LEAD_S]
        start, end = (self._gear(float(np.median(x))) for x in (before[-8:], position[-5:]))
        if len(before) < 3:
            return "with too few pulses before it"
        if start is None:
            return BETWEEN_GEARS
        pushed = ["BNF"[c] for _, c, duty in episode.commands if duty >= self._duty_open]
        wanted = [gear for gear in pushed if gear != start]
        moving = np.flatnonzero(np.abs(position - np.median(position[-5:])) > 3e-4)
        first = max(int(np.searchsorted(measured_s, 0.0)), 1)
        still = end == start and not (len(moving) and moving[-1] >= first)
        last_command_ns = episode.commands[-1][0]
        lasted_s = (last_command_ns - episode.begin_ns) / NS_PER_S
        gave_up = self._gave_up(episode, measured_s, position)
        if end is None or gave_up or (end == start and wanted and lasted_s > GIVEN_UP_S):
            failed, end = True, wanted[-1] if wanted else start
            off_s = episode.s(last_command_ns)
            last = int(np.searchsorted(measured_s, off_s + 0.1))  # it may still move then
        elif still:
            return "without motion"
        else:
            failed, last = False, int(moving[-1]) + 7 if len(moving) else 0
        used = slice(first, min(max(last, first + 12), len(position), first + 96))
        return RecordedShift(
            self._source,
            episode.begin_ns / NS_PER_S,
            start,
            end,
            tuple((episode.s(at_ns), chamber, duty) for at_ns, chamber, duty in episode.commands),
            measured_s[used],
            position[used],
            0.0 if end == "N" else self._difference(episode, measured_s[used], position[used]),
            self._supply_pa,
            failed,
            tuple(-math.inf if at_ns is None else episode.s(at_ns) for at_ns in episode.off_ns),
        )

    def _gave_up(self, episode: _Episode, time_s: Floats, position_m: Floats) -> bool:
        """Return whether a gear was commanded for long and not reached before another one was."""
        ends_ns = [*(at for at, _ in episode.targets[1:]), episode.commands[-1][0]]
        for (at_ns, target), end_ns in zip(episode.targets, ends_ns, strict=False):
            begin_s, end_s = episode.s(at_ns), episode.s(end_ns)
            during = position_m[(time_s > begin_s) & (time_s < end_s + 0.05)]
            late = target is not Gear.UNKNOWN and end_s - begin_s > GIVEN_UP_S
            if late and target.name[0] not in map(self._gear, during):
                return True
        return False

    def _gear(self, position_m: float) -> str | None:
        for name, at_m in (("N", 0.0), ("B", self._stroke_m), ("F", -self._stroke_m)):
            if abs(position_m - at_m) < 0.25 * self._stroke_m:
                return name
        return None

    def _difference(self, episode: _Episode, time_s: Floats, position_m: Floats) -> float:
        """Return the speed difference at the last instant at which the stay was near neutral."""
        near = np.flatnonzero(np.abs(position_m) < 0.25 * self._stroke_m)
        if not len(near) or near[-1] == len(position_m) - 1:
            return 0.0
        until_ns = episode.begin_ns + round((time_s[near[-1]] + 0.002) * NS_PER_S)
        until_ns -= round(LEAD_S * NS_PER_S)
        for time_ns, frame in reversed(episode.frames[DrivelineSpeeds]):
            if time_ns <= until_ns and is_intact(DrivelineSpeeds, frame):
                message = decode(frame)
                assert isinstance(message, DrivelineSpeeds)
                return message.input_rad_s - message.output_rad_s
        return float("nan")


def shifts_of(
    path: str,
    parameters: ParameterSet,
    mapping: SignalMapping | None,
    skipped: Counter[str],
    faults: list[str] | None = None,
) -> Iterator[RecordedShift]:
    """Yield the shifts of one log, in bounded memory; `skipped` counts the others by their reason.

    mapping: what another layout's signals stand for. faults: takes in one line what is not whole in the log.
    Raises InputError for a file that is no log, for one without what a shift needs, and for one of
    several buses that have it.
    """
    reader = ShiftReader(path, parameters)
    log = open_log(path)
    arrivals: Iterable[Arrival] = RecordedFrames(_of_one_bus(log), path=path)
    if mapping is not None:
        arrivals = _translated(mapping, log)
    for arrival in arrivals:
        if (shift := reader.take(arrival)) is not None:
            yield shift
    if (shift := reader.finish()) is not None:
        yield shift
    skipped.update(reader.skipped)
    if faults is not None and log.report.faults:
        faults.append(log.report.faults)
    if not log.report.frames:
        raise InputError(f"{path}: no CAN frame; expected at least one")
    for kind in NEEDED.values():
        if not reader.frames[kind]:
            hint = "the signals that FILE of --map names" if mapping else "those, or --map FILE"
            raise InputError(
                f"{path}: no {kind.__name__} ({can_id_of(kind):X}) among "
                f"{counted(log.report.frames, 'frame')}; expected {hint}"
            )


def _of_one_bus(log: LogReader) -> Iterator[LogFrame]:
    """Yield the frames of a log. Raises InputError where a second channel has commands or pulses."""
    channels: dict[int, str] = {}
    for entry in log:
        if entry.extended and entry.can_id in NEEDED:
            first = channels.setdefault(entry.can_id, entry.channel)
            if entry.channel != first:
                raise InputError(
                    f"{log.path}: {NEEDED[entry.can_id].__name__} on channels {first} and "
                    f"{entry.channel}; expected one bus: opc4 convert --channel {first} takes it out"
                )
        yield entry


def _translated(mapping: SignalMapping, log: Iterable[LogFrame]) -> Iterator[Arrival]:
    """Yield the frames of our contract that mapped ones stand for; end-to-end protection is ours.

    Raises InputError if duties or pulses are not mapped.
    """
    duties: tuple[Meaning, ...] = ("duty_b", "duty_n", "duty_f")
    for meaning in (*duties, "pulse_s"):
        if not mapping.messages_of(meaning):
            raise InputError(
                f"{mapping.path}: no signal for {meaning}; expected duty_b, duty_n, duty_f, "
                "pulse_s, and where present coil_temperature_k, input_shaft_rad_s, "
                "output_shaft_rad_s, supply_pressure_pa"
            )
    known: dict[Meaning, float] = {"coil_temperature_k": 293.15}
    pulses = count()
    kinds = ValveCommand, SafetyBlow, PositionPulse, DrivelineSpeeds
    command, blow, pulse, speeds = (Protector(kind).protect for kind in kinds)
    find = lru_cache(20_000)(mapping.sender)
    for entry in log:
        if entry.remote or entry.error:
            continue
        sender = find(entry.channel, entry.can_id, entry.extended)
        if sender is None or len(entry.data) < mapping.length(sender.message):
            continue
        values = mapping.values(sender, entry.data)
        carried = {mapping.rows[k].meaning: value for k, value in values.items()}
        known.update(carried)
        at = entry.time_ns
        if carried.keys() & set(duties):
            b, n, f = (min(max(known.get(name, 0.0), 0.0), 1.0) for name in duties)
            yield Arrival(at, ValveCommand, command(ValveCommand(b, n, f, Gear.UNKNOWN)))
            yield Arrival(at, SafetyBlow, blow(NO_BLOW))
        if "pulse_s" in carried:
            values_of_pulse = known["pulse_s"], known["coil_temperature_k"], next(pulses) & 0xFF
            with suppress(CodecError):  # beyond what a pulse can be
                yield Arrival(at, PositionPulse, pulse(PositionPulse(*values_of_pulse)))
        if carried.keys() & set(SHAFT_SPEEDS):
            shaft_in, output = (known.get(name, 0.0) for name in SHAFT_SPEEDS)
            yield Arrival(at, DrivelineSpeeds, speeds(DrivelineSpeeds(shaft_in, output)))
        if "supply_pressure_pa" in carried:
            gauge_pa = carried["supply_pressure_pa"] - 101325.0
            yield Arrival(at, None, encode(Air1(min(max(gauge_pa, 0.0), 1.9e6))))
