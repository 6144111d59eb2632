"""What the strokes that `opc4 diagnose --next` proposes are worth, against repeats and random strokes."""

from tests.support.next_strokes import measure

__all__ = ["measure"]
