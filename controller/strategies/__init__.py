"""The interface of a strategy, which carries out a push, and the registry of all strategies."""

from __future__ import annotations

import abc
import importlib
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from msgspec import Struct

from can_dbc.errors import InputError, unknown_name
from can_dbc.messages import Chamber, Gear
from can_dbc.typed_toml import convert
from controller.position import Estimate
from controller.settings import ControlConfig, Settings

NAMES: Mapping[str, str] = {
    "open_loop": "controller.strategies.open_loop:OpenLoop",
    "blow_cut": "controller.strategies.open_loop:BlowCut",
    "air_cushion": "controller.strategies.air_cushion:AirCushion",
    "synchro_brake": "controller.strategies.synchro_brake:SynchroBrake",
    "fixed_programme": "controller.strategies.fixed_programme:FixedProgramme",
    "sliding_mode": "controller.strategies.sliding_mode:SlidingMode",
    "bang_bang": "controller.strategies.bang_bang:BangBang",
    "predictive": "controller.strategies.predictive:Predictive",
}
"""Name of each strategy and where its class is; loaded when first used."""


class Duties(NamedTuple):
    """Duty cycles of the three valves, 0 to 1."""

    b: float
    n: float
    f: float


OFF = Duties(0.0, 0.0, 0.0)
"""All chambers vented."""


class ShiftContext(NamedTuple):
    """The push that a strategy carries out.

    `charged`: chamber that drives the stay to `leg`; `attempt`: number of earlier pushes of this leg; `apart_rad_s`:
    input minus output speed as last reported, None without a valid report, `apart_ns`: the step that received it
    first.
    """

    leg: Gear
    charged: Chamber
    start_ns: int
    attempt: int
    apart_rad_s: float | None = None
    apart_ns: int = 0


def one_chamber(chamber: Chamber, duty: float) -> Duties:
    """Return the duties that open one valve and leave the others closed."""
    return Duties(
        duty if chamber is Chamber.B else 0.0,
        duty if chamber is Chamber.N else 0.0,
        duty if chamber is Chamber.F else 0.0,
    )


class Strategy(abc.ABC):
    """Decides the duties while a position is pushed for and until it is confirmed.

    The firmware decides when to push, what is confirmed and what follows. It refuses duties that fill backward and
    forward together, or one of them sooner than shift.interlock_s and a period after the other (`Interlock.allows`): an
    internal fault. A strategy keeps a bounded state, does bounded work per call, and reads no clock.
    """

    Parameters: ClassVar[type[Struct]] = Settings
    """Of the strategy's settings, from `strategy_parameters`."""

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        self.config = config
        self.parameters = parameters

    @abc.abstractmethod
    def reset(self) -> None:
        """Forget the last push; a new one starts with the next `command`."""

    @abc.abstractmethod
    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        """Return the duties for the coming period; called once per step of a push."""

    def blow_s(self, configured_s: float, leg: Gear, follows: bool) -> float:
        """Return how long the blow after `leg` lasts, at most as configured; `follows`: a gear is to be engaged next."""
        return configured_s


def strategy_class(name: str) -> type[Strategy]:
    """Return the class of a strategy. Raises InputError for an unknown name."""
    if name not in NAMES:
        raise InputError(f"strategy: {name!r} is {unknown_name(name, NAMES)}")
    module, _, attribute = NAMES[name].partition(":")
    loaded: type[Strategy] = getattr(importlib.import_module(module), attribute)
    return loaded


def parameters(name: str, table: Mapping[str, Any]) -> Struct:
    """Make the settings record of a strategy. Raises InputError for an unknown strategy and a wrong table."""
    kind = strategy_class(name).Parameters
    return convert(dict(table), kind, key="strategy_parameters")
