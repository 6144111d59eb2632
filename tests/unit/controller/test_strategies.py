"""The interface of strategies, the registry, and the open loop."""

from __future__ import annotations

import pytest

from can_dbc.messages import Chamber, Gear
from controller import strategies
from controller.config import FirmwareConfig, create_strategy
from controller.position import Estimate
from controller.strategies import OFF, Duties, ShiftContext, one_chamber
from controller.strategies.open_loop import OpenLoop

ANYWHERE = Estimate(True, 0.003, 0.002, 0.5, ())


def context(charged: Chamber) -> ShiftContext:
    return ShiftContext(leg=Gear.BACKWARD, charged=charged, start_ns=0, attempt=0)


@pytest.mark.parametrize("name", list(strategies.NAMES))
def test_every_registered_strategy_can_be_made(name: str) -> None:
    strategy = create_strategy(FirmwareConfig(strategy=name))
    assert type(strategy) is strategies.strategy_class(name)
    assert type(strategy.parameters) is strategy.Parameters


def test_open_loop_is_the_default() -> None:
    assert type(create_strategy(FirmwareConfig())) is OpenLoop


@pytest.mark.parametrize(
    ("chamber", "duties"),
    [
        (Chamber.B, Duties(0.98, 0.0, 0.0)),
        (Chamber.N, Duties(0.0, 0.98, 0.0)),
        (Chamber.F, Duties(0.0, 0.0, 0.98)),
        (Chamber.NONE, OFF),
    ],
)
def test_one_chamber(chamber: Chamber, duties: Duties) -> None:
    assert one_chamber(chamber, 0.98) == duties


@pytest.mark.parametrize("chamber", [Chamber.B, Chamber.N, Chamber.F])
def test_open_loop_fills_the_charged_chamber_whatever_happens(chamber: Chamber) -> None:
    strategy = create_strategy(FirmwareConfig(duty=0.9))
    for now_ns in (0, 10_000_000, 10**12):
        assert strategy.command(now_ns, ANYWHERE, context(chamber)) == one_chamber(chamber, 0.9)
    strategy.reset()
    assert strategy.command(0, ANYWHERE, context(chamber)) == one_chamber(chamber, 0.9)


def test_the_blow_is_as_configured_unless_a_strategy_says_otherwise() -> None:
    strategy = create_strategy(FirmwareConfig())
    for follows in (False, True):
        assert strategy.blow_s(0.123, Gear.NEUTRAL, follows) == 0.123
