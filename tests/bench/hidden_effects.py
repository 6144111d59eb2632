"""Hidden effects: how often the diagnosis finds what an independent implementation hid."""

from tests.support.hidden_study import measure

__all__ = ["measure"]
