"""Other instruments: campaigns re-sampled, with more noise, without gauges, and how they are judged."""

from tests.support.instruments import measure

__all__ = ["measure"]
