"""Causes from a truck's own bus: shifts of CAN logs against the plant under the recorded commands."""
