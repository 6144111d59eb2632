"""Measurements side by side, in one run: each figure next to a floor or a peer, as a ratio.

`python -m tests.bench [NAME...]` prints tables; nothing here is a test with a time limit.
"""
