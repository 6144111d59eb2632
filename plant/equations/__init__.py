"""The thesis's equations as compiled functions: right-hand sides, guards and resets."""
