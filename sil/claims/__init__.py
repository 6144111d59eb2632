"""The thesis's claims, and what the simulation shows of each: met, partly, not met, or cannot be shown."""
