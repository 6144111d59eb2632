"""Devices around the actuator: valves and their drivers, sensors, driveline, and their faults."""
