"""Instants and durations are whole nanoseconds."""

NS_PER_S = 1_000_000_000
