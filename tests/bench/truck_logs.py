"""Truck logs with no or one cause through `opc4 diagnose LOG`: detection and false alarms."""

from tests.support.truck_logs import measure

__all__ = ["measure"]
