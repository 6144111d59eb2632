"""Which causes a truck's bus cannot separate: by Fisher information of tests/reference, and as diagnosed."""

from tests.support.bus_groups import measure

__all__ = ["measure"]
