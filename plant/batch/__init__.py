"""Many strokes in one call: lanes, predictions and derivatives."""
