"""The project's input error, as the plant raises it (defined beside the CAN contract)."""

from can_dbc.errors import InputError

__all__ = ["InputError"]
