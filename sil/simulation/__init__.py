"""A scenario from its file to its result: build, run, metrics, expectations."""
