"""Measurement campaigns: read, written, simulated."""
