"""The control unit's firmware: pulse to position, filter, shift state machine, strategies."""
