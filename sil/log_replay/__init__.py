"""Recorded traffic through the firmware, or the plant, alone; its answers against the recorded ones."""
