"""Frames a second read and replayed, compared with python-can's reader and a pass-through like canplayer's."""

from tests.support.replay_cost import measure

__all__ = ["measure"]
