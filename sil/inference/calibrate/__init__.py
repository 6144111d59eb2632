"""A model fitted to healthy strokes of one unit: the baseline of its later diagnoses."""
