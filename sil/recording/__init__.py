"""Recording of a run, and reading it back."""
