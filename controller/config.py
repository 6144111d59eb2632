"""The firmware's whole configuration: the settings all parts share, and the strategy's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import field

from can_dbc.typed_toml import convert
from controller import strategies
from controller.settings import ControlConfig


class FirmwareConfig(ControlConfig, frozen=True):
    """All settings of the firmware, by default today's. Raises InputError 'FIELD: what; expected ...'."""

    strategy: str = "open_loop"
    """How a push is carried out: one of controller.strategies.NAMES."""
    strategy_parameters: dict[str, Any] = field(default_factory=dict)
    """The strategy's own settings; see its Parameters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        strategies.parameters(self.strategy, self.strategy_parameters)


def create_strategy(config: FirmwareConfig) -> strategies.Strategy:
    """Return a new instance of the strategy that the settings name."""
    kind = strategies.strategy_class(config.strategy)
    strategy = kind(config, strategies.parameters(config.strategy, config.strategy_parameters))
    strategy.reset()
    return strategy


def load_config(table: Mapping[str, Any], source: str) -> FirmwareConfig:
    """Make the settings from a parsed TOML table; `filter = false` switches the filter off.

    Raises InputError 'SOURCE: FIELD: what; expected ...'.
    """
    raw = dict(table)
    if isinstance(raw.get("filter"), bool):
        raw["filter"] = {"enabled": raw["filter"]}
    return convert(raw, FirmwareConfig, source)
