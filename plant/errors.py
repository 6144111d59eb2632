"""The plant's errors; the project's input error is defined with the CAN contract."""

from can_dbc.errors import InputError

__all__ = ["InputError", "IntegrationError", "NoVolumeError"]


class IntegrationError(ArithmeticError):
    """The integrator could not go on; says where and why."""


class NoVolumeError(InputError, IntegrationError):
    """A chamber shrinks to nothing: its volume was given too small."""
