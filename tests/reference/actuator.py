"""The judge: both actuators solved by scipy's solve_ivp, restarted at every event.

Bodies on one line, all counted in the direction of x_s: the stay 0, piston 1 at z1 = x_1, piston 2 at
z2 = -x_2 (the fixed piston is a stay alone).  Which of them touch, rest or slide is found by trying
every combination and keeping the one whose forces are consistent: contacts push only, friction at
rest is any force within its bound, sliding friction opposes motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from tests.reference import parts
from tests.reference.parts import Flow, Values

NEAR_M = 1e-9
NEAR_M_S = 1e-10
SLOW_M_S = 1e-5  # touching bodies that part slower than this stay together (no Zeno sequences)
NEAR_N = 1e-6
NEAR_PA = 1e-3
NEAR_M_S2 = 1e-4
EPS_M = 1e-13  # rounding of a gap just opened

State = list[float]
Guard = tuple[str, Callable[[State], float]]


class Contact(NamedTuple):
    """Contact of a piston with the stay: gap = sign (z - s) + offset; sign of the push on the piston."""

    name: str
    piston: int
    sign: int
    offset: float


class Mode(NamedTuple):
    """Contacts that transmit force, direction of each body (0 at rest), the synchronizer's hold."""

    joints: tuple[Contact, ...]
    directions: tuple[int, ...]
    blocked: int


class Happening(NamedTuple):
    """One event: instant [s], name, stay position [m], speed of the stay into a stop [m/s]."""

    time_s: float
    name: str
    position_m: float
    speed_m_s: float


@dataclass(frozen=True)
class Case:
    """What the judge knows of a stroke."""

    kind: str
    supply_pa: float = 900000.0
    commands: tuple[tuple[float, str, float], ...] = ()
    charged: tuple[str, ...] = ()
    damper: str | None = None
    spring_n_per_m: float = 0.0
    start_m: float = 0.0
    mounted: bool = False
    mesh_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0


class Solution(NamedTuple):
    """States at the wanted instants, and what happened."""

    states: np.ndarray
    happenings: list[Happening]


class Actuator:
    """Bodies, chambers and the march from event to event; subclasses give the equations."""

    chambers: str
    bodies: int
    restitution: float
    masses: tuple[float, ...]
    contacts: tuple[Contact, ...] = ()

    def __init__(self, values: Values, case: Case) -> None:
        self.v = values
        self.case = case
        self.flow = Flow(values)
        self.u = {name: float(name in case.charged) for name in self.chambers}
        self.now_s = 0.0
        self.turned_s: dict[str, float] = {}
        self.restitution = values["stops.restitution"]
        self.blocked = 0
        self.oil_rests = True
        self.linkage = values["truck.F_gearbox"] if case.mounted else 0.0

    # --- what a subclass says ---------------------------------------------------------------
    def initial(self) -> State:
        raise NotImplementedError

    def drives(self, y: State) -> list[float]:
        """Force on each body without friction and contacts [N]."""
        raise NotImplementedError

    def volumes(self, y: State) -> list[tuple[float, float]]:
        """Volume and its rate of each chamber [m^3, m^3/s]."""
        raise NotImplementedError

    def friction(self, y: State, body: int, direction: int, sliding: bool) -> float:
        """Friction of a body towards a direction [N], sliding or at rest."""
        raise NotImplementedError

    def limits(self, y: State, body: int) -> tuple[float, float]:
        """Lowest and highest position of a body now [m]."""
        raise NotImplementedError

    # --- places in the state ----------------------------------------------------------------
    @property
    def first_pressure(self) -> int:
        return 2 * self.bodies

    @property
    def spent(self) -> int:
        return 2 * self.bodies + len(self.chambers)

    @property
    def oil(self) -> int:
        return self.spent + 1

    def gap(self, y: State, contact: Contact) -> float:
        return contact.sign * (y[2 * contact.piston] - y[0]) + contact.offset

    def closing(self, y: State, contact: Contact) -> float:
        return -contact.sign * (y[2 * contact.piston + 1] - y[1])

    # --- continuous motion --------------------------------------------------------------------
    def accelerations(self, y: State, mode: Mode) -> list[float]:
        drive = self.drives(y)
        net = [
            drive[b] - d * self.friction(y, b, d, True) if d else 0.0
            for b, d in enumerate(mode.directions)
        ]
        out = [net[b] / self.masses[b] if d else 0.0 for b, d in enumerate(mode.directions)]
        if mode.joints and mode.directions[0]:
            group = [0, *(c.piston for c in mode.joints)]
            common = sum(net[b] for b in group) / sum(self.masses[b] for b in group)
            for b in group:
                out[b] = common
        return out

    def push(self, y: State, mode: Mode, contact: Contact) -> float:
        """Force that a moving contact transmits [N], >= 0 while it lasts."""
        b = contact.piston
        d = mode.directions[b]
        a = self.accelerations(y, mode)[b]
        free = self.drives(y)[b] - d * self.friction(y, b, d, True)
        return contact.sign * (self.masses[b] * a - free)

    def rates(self, y: State, mode: Mode) -> State:
        out = [0.0] * len(y)
        a = self.accelerations(y, mode)
        for b in range(self.bodies):
            if mode.directions[b]:
                out[2 * b] = y[2 * b + 1]
                out[2 * b + 1] = a[b]
        v = self.v
        r, atmosphere = v["gas.R_air"], v["gas.P_atm"]
        for k, ((volume, rate), name) in enumerate(
            zip(self.volumes(y), self.chambers, strict=True)
        ):
            i = self.first_pressure + k
            if self.u[name] == 1.0:
                gas = v["alpha.alpha_m1"] * self.flow.charge(y[i], self.case.supply_pa)
                alpha = v["alpha.alpha_1"]
            else:
                gas = -v["alpha.alpha_m2"] * self.flow.discharge(y[i], atmosphere)
                alpha = v["alpha.alpha_2"]
            out[i] = (r * gas - alpha * y[i] * rate) / volume
        if mode.blocked:
            out[self.spent] = max(0.0, mode.blocked * self.pressing(y, mode))
        if self.case.damper == "compressible" and not self.oil_rests:
            side = self.side(y)
            out[self.oil] = parts.oil_rate(abs(y[0]), side * y[1], y[self.oil], v)
        return out

    def pressing(self, y: State, mode: Mode) -> float:
        """Force that drives the resting stay, with the pistons that rest and press on it [N]."""
        drive = self.drives(y)
        total = drive[0]
        for contact in self.contacts:
            b = contact.piston
            if mode.directions[b] == 0 and abs(self.gap(y, contact)) <= NEAR_M:
                total += contact.sign * min(contact.sign * drive[b], 0.0)
        return total

    @staticmethod
    def side(y: State) -> float:
        """Side of neutral on which the damper acts; at neutral the one the stay goes to."""
        return 1.0 if y[0] > 0.0 or (y[0] == 0.0 and y[1] >= 0.0) else -1.0

    def damper_force(self, y: State) -> float:
        """Force of the oil damper on the stay in the direction of x_s [N]."""
        if self.case.damper is None:
            return 0.0
        side = self.side(y)
        over = y[self.oil]
        if self.case.damper == "incompressible":
            over = parts.oil_pressure(abs(y[0]), side * y[1], self.v)
        return -side * self.v["damper.A_oil"] * max(over, 0.0)

    # --- rest ---------------------------------------------------------------------------------
    def rest_margin(self, y: State, body: int, joints: Sequence[Contact]) -> float:
        """How far a body (the stay with its joints) is from having to move [N]; negative: it must."""
        drive = self.drives(y)

        def reaction(b: int) -> tuple[float, float]:
            """Forces that friction and stops can add to a resting body."""
            low, high = self.limits(y, b)
            minus = -inf if y[2 * b] >= high - NEAR_M else -self.friction(y, b, 1, False)
            plus = inf if y[2 * b] <= low + NEAR_M else self.friction(y, b, -1, False)
            return minus, plus

        minus, plus = reaction(body)
        if body != 0:
            return min(drive[body] + plus, -(drive[body] + minus))
        low, high = drive[0] + minus, drive[0] + plus
        margin = inf
        for contact in joints:
            minus, plus = reaction(contact.piston)
            # what the piston can give to the stay; the contact must push
            first, last = drive[contact.piston] + minus, drive[contact.piston] + plus
            if contact.sign > 0:
                margin = min(margin, -first)
                last = min(last, 0.0)
            else:
                margin = min(margin, last)
                first = max(first, 0.0)
            low, high = low + first, high + last
        return min(margin, high, -low)

    def stopped(self, y: State, body: int, direction: int) -> bool:
        low, high = self.limits(y, body)
        if direction > 0:
            return y[2 * body] >= high - NEAR_M
        return y[2 * body] <= low + NEAR_M

    # --- choosing the mode ----------------------------------------------------------------------
    def modes(self, y: State) -> Iterator[Mode]:
        touching = [
            c
            for c in self.contacts
            if self.gap(y, c) <= NEAR_M and abs(self.closing(y, c)) <= NEAR_M_S
        ]
        for count in range(len(touching) + 1):
            for joints in itertools.combinations(touching, count):
                joined = {c.piston for c in joints}
                if len(joined) < count:
                    continue
                choices = []
                for b in range(self.bodies):
                    speed = y[2 * b + 1]
                    sign = (speed > 0.0) - (speed < 0.0)
                    choices.append([sign] if sign else [0, 1, -1])
                for directions in itertools.product(*choices):
                    if all(directions[b] == directions[0] for b in joined):
                        yield Mode(joints, directions, 0)

    def consistent(self, y: State, mode: Mode, released: str, slipped: bool) -> bool:
        a = self.accelerations(y, mode)
        joined = {c.piston for c in mode.joints}
        for b in range(self.bodies):
            if b in joined:
                continue
            group = [0, *joined] if b == 0 else [b]
            d = mode.directions[b]
            if d == 0:
                margin = self.rest_margin(y, b, mode.joints)
                if margin < (NEAR_N if slipped else 0.0):
                    return False
            elif y[2 * b + 1] == 0.0:
                if d * a[b] < -NEAR_M_S2 or not self.breaks(y, group, d):
                    return False
                if any(self.stopped(y, k, d) for k in group):
                    return False
        for contact in self.contacts:
            if contact in mode.joints:
                if contact.name == released:
                    return False
                if mode.directions[0] and self.push(y, mode, contact) < 0.0:
                    return False
            elif self.gap(y, contact) <= NEAR_M and abs(self.closing(y, contact)) <= NEAR_M_S:
                parting = contact.sign * (a[contact.piston] - a[0])
                if parting < (-NEAR_M_S2 if slipped or contact.name == released else 0.0):
                    return False
        return True

    def breaks(self, y: State, group: list[int], d: int) -> bool:
        """True if a group at rest breaks away towards d, alone or with its neighbours; what would then pull parts at once."""
        drive = self.drives(y)
        near = [
            c.piston
            for c in self.contacts
            if self.gap(y, c) <= NEAR_M and y[2 * c.piston + 1] == y[1] == 0.0
        ]
        wholes = [tuple(group)]
        if 0 in group or group[0] in near:
            subsets = itertools.chain.from_iterable(
                itertools.combinations(sorted({*near, *group} - {0}), count) for count in (1, 2)
            )
            wholes += [(0, *pistons) for pistons in subsets]
        return any(
            d * sum(drive[k] for k in whole)
            >= sum(self.friction(y, k, d, False) for k in whole) - NEAR_N
            for whole in wholes
            if set(group) <= set(whole)
        )

    def choose(self, y: State, released: str = "", slipped: bool = False) -> Mode:
        for mode in sorted(self.modes(y), key=lambda mode: sum(map(abs, mode.directions))):
            if self.consistent(y, mode, released, slipped):
                self.blocked = self.held(y, mode)
                outward = mode.directions[0] * y[0] > 0.0 or (y[0] == 0.0 and mode.directions[0])
                self.oil_rests = y[self.oil] <= NEAR_PA and not outward
                return mode._replace(blocked=self.blocked)
        raise AssertionError(f"no consistent mode at {y}")

    def held(self, y: State, mode: Mode) -> int:
        """+1 or -1 while the synchronizer holds the stay there, else 0."""
        at = abs(abs(y[0]) - self.v["synchronizer.x_block"]) <= NEAR_M
        unspent = y[self.spent] < self.case.sync_impulse_n_s
        if not (at and unspent and mode.directions[0] == 0):
            return 0
        return 1 if y[0] > 0.0 else -1

    # --- events ---------------------------------------------------------------------------------
    def guards(self, y: State, mode: Mode) -> list[Guard]:
        out: list[Guard] = []
        joined = {c.piston for c in mode.joints}
        for b, d in enumerate(mode.directions):
            if b in joined:
                continue
            if d == 0:
                out.append((f"slip {b}", lambda y, b=b: self.rest_margin(y, b, mode.joints)))
            else:
                out.append((f"turn {b}", lambda y, b=b, d=d: d * y[2 * b + 1]))
        for b, d in enumerate(mode.directions):
            if d:
                bound = self.limits(y, b)[1 if d > 0 else 0]
                if abs(bound) < inf:
                    out.append(
                        (f"limit {b}", lambda y, b=b, d=d, x=bound: d * (x - y[2 * b]) + EPS_M)
                    )
        for contact in self.contacts:
            d = mode.directions
            if contact in mode.joints:
                if d[0]:
                    out.append((f"part {contact.name}", lambda y, c=contact: self.push(y, mode, c)))
            elif contact.piston not in joined and (d[0] or d[contact.piston]):
                out.append((f"meet {contact.name}", lambda y, c=contact: self.gap(y, c) + EPS_M))
        if self.case.damper == "compressible" and not self.oil_rests:
            out.append(("oil empty", lambda y: y[self.oil]))
        if self.case.damper is not None and mode.directions[0] * y[0] < 0.0:
            side = 1.0 if y[0] > 0.0 else -1.0  # the damper acts on the other side from there
            out.append(("neutral", lambda y: side * y[0] + EPS_M))
        if mode.blocked:
            out.append(("unblock", lambda y: self.case.sync_impulse_n_s - y[self.spent]))
        return out

    def collide(self, y: State) -> tuple[str, float]:
        """Resolve every closing contact; returns "stop" or "block" and its speed, or ("", 0)."""
        impact = ("", 0.0)
        for b in range(1, self.bodies):
            if abs(y[2 * b]) <= NEAR_M and y[2 * b + 1] == 0.0:
                y[2 * b] = 0.0  # seated
        for _ in range(50):
            busy = False
            for b in range(1, self.bodies):
                for bound, toward in zip(self.limits(y, b), (-1, 1), strict=True):
                    if abs(y[2 * b] - bound) <= NEAR_M and toward * y[2 * b + 1] > 0.0:
                        y[2 * b], y[2 * b + 1] = bound, self.bounced(y[2 * b + 1])
                        busy = True
            wall = self.wall(y)
            if wall is not None:
                at, is_block = wall
                if abs(y[1]) > impact[1]:
                    impact = ("block" if is_block else "stop", abs(y[1]))
                y[0], y[1] = at, 0.0 if is_block else self.bounced(y[1])
                busy = True
            for contact in self.contacts:
                closing = self.closing(y, contact)
                if self.gap(y, contact) > NEAR_M or abs(closing) <= NEAR_M_S:
                    continue
                if closing > -SLOW_M_S:
                    self.merge(y, contact)
                    busy = True
            if not busy:
                return impact
        raise AssertionError(f"collision without end at {y}")

    def bounced(self, speed: float) -> float:
        after = -self.restitution * speed
        return after if abs(after) > 1e-4 else 0.0

    def wall(self, y: State) -> tuple[float, bool] | None:
        """Place at which the stay, moving, is stopped now, and whether it is the synchronizer."""
        if y[1] == 0.0:
            return None
        d = 1 if y[1] > 0.0 else -1
        return self.wall_towards(y, d)

    def wall_towards(self, y: State, d: int) -> tuple[float, bool] | None:
        bound = self.limits(y, 0)[1 if d > 0 else 0]
        if abs(y[0] - bound) <= NEAR_M:
            return bound, abs(bound) == self.v["synchronizer.x_block"]
        for contact in self.contacts:  # a piston on its outer stop is as fixed as the housing
            inward = 1 if contact.piston == 1 else -1
            seated = abs(y[2 * contact.piston]) <= NEAR_M and y[2 * contact.piston + 1] == 0.0
            near = self.gap(y, contact) <= NEAR_M
            if near and seated and d == contact.sign == inward:
                return y[2 * contact.piston] + contact.sign * contact.offset, False
        return None

    def merge(self, y: State, contact: Contact) -> None:
        """Inelastic contact: common velocity, momentum kept, unless the stay cannot give way."""
        b = contact.piston
        pushed = -contact.sign
        slow = abs(self.closing(y, contact)) < SLOW_M_S
        if y[1] == 0.0 and (slow or self.wall_towards(y, pushed) is not None):
            y[2 * b + 1] = 0.0
            return
        group = [0, b]
        while True:
            mass = sum(self.masses[k] for k in group)
            common = sum(self.masses[k] * y[2 * k + 1] for k in group) / mass
            more = [
                c.piston
                for c in self.contacts
                if c.piston not in group
                and self.gap(y, c) <= NEAR_M
                and -c.sign * (y[2 * c.piston + 1] - common) > -SLOW_M_S
            ]
            if not more:
                break
            group += more
        for k in group:
            y[2 * k + 1] = common

    # --- march ----------------------------------------------------------------------------------
    def switches(self) -> list[tuple[float, str, float]]:
        return parts.valve_switches(self.case.commands, self.case.charged, self.v)

    def tolerances(self) -> list[float]:
        return [1e-13, 1e-11] * self.bodies + [1e-5] * len(self.chambers) + [1e-11, 1e-4]

    def rates_at(self, time_s: float, y: State, mode: Mode) -> State:
        self.now_s = time_s
        return self.rates(y, mode)

    def solve(
        self, times: Sequence[float], *, rtol: float = 1e-11, max_step: float = 5e-4
    ) -> Solution:
        """Integrate from 0 to the last of `times` (ascending) with events located and restarted."""
        switches = self.switches()
        times = np.asarray(times, dtype=float)
        end = float(times[-1])
        y = self.initial()
        mode = self.choose(y)
        states = np.zeros((len(times), len(y)))
        happenings: list[Happening] = []
        written, t = 0, 0.0
        stiff = self.case.damper == "compressible"
        atol = self.tolerances()
        while t < end:
            while switches and switches[0][0] <= t:
                when, name, u = switches.pop(0)
                self.u[name] = u
                self.turned_s[name] = when
            until = min(end, switches[0][0]) if switches else end
            guards = self.guards(y, mode)
            events = []
            for _, guard in guards:
                event = lambda _t, y, g=guard: g(y.tolist())  # noqa: E731
                event.terminal, event.direction = True, -1.0  # type: ignore[attr-defined]
                events.append(event)
            present = mode
            run = solve_ivp(
                lambda at, y: self.rates_at(at, y.tolist(), present),  # noqa: B023
                (t, until),
                np.array(y),
                method="LSODA" if stiff else "DOP853",
                rtol=rtol,
                atol=atol,
                events=events,
                dense_output=True,
                max_step=max_step,
            )
            assert run.success, run.message
            reached = float(run.t[-1])
            last = int(np.searchsorted(times, reached, side="right"))
            if last > written:
                states[written:last] = run.sol(times[written:last]).T
                written = last
            y = run.y[:, -1].tolist()
            name = ""
            if run.status == 1:
                k = min((float(at[0]), index) for index, at in enumerate(run.t_events) if len(at))[
                    1
                ]
                name = guards[k][0]
            t = reached
            mode = self.act(t, y, name, mode, happenings)
        states[written:] = y
        return Solution(states, happenings)

    def act(self, t: float, y: State, name: str, mode: Mode, happenings: list[Happening]) -> Mode:
        """Reset at an event, or nothing at a valve's switching; returns the next mode."""
        for b, d in enumerate(mode.directions):
            if d == 0:  # an implicit method leaves rounding in a constant
                y[2 * b + 1] = 0.0
        if name.startswith("turn"):
            b = int(name[-1])
            for k in [b, *(c.piston for c in mode.joints if b == 0)]:
                y[2 * k + 1] = 0.0
        elif name == "oil empty":
            y[self.oil] = 0.0
        elif name == "unblock":
            y[self.spent] = self.case.sync_impulse_n_s
            self.blocked = 0
        for contact in self.contacts:
            if name == f"meet {contact.name}" or contact in mode.joints:
                y[2 * contact.piston] = y[0] - contact.sign * contact.offset
        impact, speed = self.collide(y)
        released = name.removeprefix("part ") if name.startswith("part") else ""
        after = self.choose(y, released, name.startswith("slip"))
        # a slip after which the same bodies rest only moved the load from one to the other
        moved = not name.startswith("slip") or after.directions != mode.directions
        if impact or (name and moved):
            happenings.append(Happening(t, impact or name, y[0], speed))
        return after


class FixedPiston(Actuator):
    """3.46-3.52: V1 = V10 + A1 x, V2 = V20 - A2 x, 0 <= x <= stroke."""

    chambers = "12"
    bodies = 1

    def __init__(self, values: Values, case: Case) -> None:
        super().__init__(values, case)
        gearbox = values["truck.m_gearbox"] if case.mounted else 0.0
        self.masses = (values["fixed.m_s"] + values["fixed.m_p"] + gearbox,)

    def initial(self) -> State:
        pressures = [
            self.case.supply_pa if name in self.case.charged else self.v["gas.P_atm"]
            for name in self.chambers
        ]
        return [self.case.start_m, 0.0, *pressures, 0.0, 0.0]

    def drives(self, y: State) -> list[float]:
        v = self.v
        gas = y[2] * v["fixed.A1"] - y[3] * v["fixed.A2"] - v["gas.P_atm"] * v["fixed.A_s"]
        spring = -self.case.spring_n_per_m * (y[0] - self.case.start_m)
        return [gas + spring + self.damper_force(y)]

    def volumes(self, y: State) -> list[tuple[float, float]]:
        v = self.v
        return [
            (v["fixed.V10"] + v["fixed.A1"] * y[0], v["fixed.A1"] * y[1]),
            (v["fixed.V20"] - v["fixed.A2"] * y[0], -v["fixed.A2"] * y[1]),
        ]

    def friction(self, y: State, body: int, direction: int, sliding: bool) -> float:
        v = self.v
        run = v["friction_fixed.F_rf"]
        if sliding:
            return run + v["friction_fixed.beta"] * abs(y[1]) + self.linkage
        return max(v["friction_fixed.F_sf"], run) + self.linkage

    def limits(self, y: State, body: int) -> tuple[float, float]:
        return 0.0, self.v["fixed.stroke"]


class LengthStroke(Actuator):
    """3.53-3.68 with errata: stay, two pistons with free travel, chambers B | N | F."""

    chambers = "BNF"
    bodies = 3

    def __init__(self, values: Values, case: Case) -> None:
        super().__init__(values, case)
        gearbox = values["truck.m_gearbox"] if case.mounted else 0.0
        piston = values["length.m_p"]
        self.masses = (values["length.m_s"] + gearbox, piston, piston)
        free = values["length.x_free_total"]
        self.contacts = (
            Contact("nut 1", 1, 1, 0.0),
            Contact("collar 1", 1, -1, free),
            Contact("nut 2", 2, -1, 0.0),
            Contact("collar 2", 2, 1, free),
        )

    def initial(self) -> State:
        v = self.v
        stroke, free = v["length.stroke"], v["length.x_free_total"]
        s = {"N": 0.0, "B": stroke, "F": -stroke}[self.case.kind[0]]
        z1 = stroke + free if s > 0.0 else 0.0
        z2 = -(stroke + free) if s < 0.0 else 0.0
        pressures = [
            self.case.supply_pa if name in self.case.charged else v["gas.P_atm"]
            for name in self.chambers
        ]
        return [s, 0.0, z1, 0.0, z2, 0.0, *pressures, 0.0, 0.0]

    def drives(self, y: State) -> list[float]:
        v = self.v
        b, n, f = y[6:9]
        stay = (b - f) * v["length.A_s"] + self.damper_force(y)
        return [stay, (b - n) * v["length.A_p"], (n - f) * v["length.A_p"]]

    def volumes(self, y: State) -> list[tuple[float, float]]:
        v = self.v
        ap, a_s = v["length.A_p"], v["length.A_s"]
        s, vs, z1, w1, z2, w2 = y[:6]
        return [
            (v["length.V_B0"] + ap * z1 + a_s * s, ap * w1 + a_s * vs),
            (v["length.V_N0"] - ap * (z1 - z2), -ap * (w1 - w2)),
            (v["length.V_F0"] - ap * z2 - a_s * s, -ap * w2 - a_s * vs),
        ]

    def friction(self, y: State, body: int, direction: int, sliding: bool) -> float:
        v = self.v
        share = "s" if body == 0 else "p"
        extra = self.linkage + self.load(y[0], direction) if body == 0 else 0.0
        run = v[f"friction_length.F_rf_{share}"]
        if sliding:
            return run + v[f"friction_length.beta_{share}"] * abs(y[2 * body + 1]) + extra
        return max(v[f"friction_length.F_sf_{share}"], run) + extra

    def load(self, x: float, direction: int) -> float:
        """Force barrier of the gearbox on the stay [N]."""
        v, peak = self.v, self.case.mesh_force_n
        if self.case.kind.startswith("N"):
            if direction * x < 0.0:
                return 0.0
            return parts.barrier(
                peak, (abs(x) - v["synchronizer.x_mesh"]) / v["synchronizer.w_mesh"]
            )
        if direction * x >= 0.0:
            return 0.0
        return parts.barrier(peak, (v["length.stroke"] - abs(x)) / v["synchronizer.w_pull"])

    def limits(self, y: State, body: int) -> tuple[float, float]:
        if body == 1:
            return 0.0, inf
        if body == 2:
            return -inf, 0.0
        reach = self.v["length.stroke"]
        block = self.v["synchronizer.x_block"]
        unspent = y[self.spent] < self.case.sync_impulse_n_s
        if self.blocked or (unspent and abs(y[0]) <= block + NEAR_M):
            reach = block
        return -reach, reach


def actuator(case: Case, changes: Mapping[str, float] | None = None) -> Actuator:
    """The actuator of a case, with nominal numbers or some of them changed."""
    values = parts.nominal(changes)
    return FixedPiston(values, case) if case.kind == "fixed" else LengthStroke(values, case)
