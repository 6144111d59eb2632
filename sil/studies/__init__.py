"""Sweeps: any value of model, firmware, sensor or bus over any design, many shifts, one table."""
