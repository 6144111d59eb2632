"""Lines of any stream: nothing lost, numbered right, memory bounded."""

from __future__ import annotations

import io

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sil.logs import text_lines
from sil.logs.text_lines import chunks, line_at, lines


class Dripping:
    """A stream that gives a few bytes at a time."""

    def __init__(self, blob: bytes, sizes: list[int]) -> None:
        self._stream = io.BytesIO(blob)
        self._sizes = sizes

    def read(self, size: int, /) -> bytes:
        drip = self._sizes[self._stream.tell() % len(self._sizes)]
        return self._stream.read(min(size, drip))


@settings(deadline=None)
@given(
    st.lists(st.binary(max_size=12).map(lambda b: b.replace(b"\n", b"x")), max_size=20),
    st.booleans(),
    st.lists(st.integers(1, 9), min_size=1, max_size=5),
)
def test_lines_are_those_of_the_text(parts: list[bytes], ended: bool, sizes: list[int]) -> None:
    blob = b"\n".join(parts) + (b"\n" if ended and parts else b"")
    found = list(lines(Dripping(blob, sizes)))
    expected = blob.split(b"\n")
    if expected[-1] == b"":
        expected.pop()
    assert [line.text.encode("latin-1") for line in found] == [
        part.removesuffix(b"\r") for part in expected
    ]
    assert [line.number for line in found] == list(range(1, len(found) + 1))
    for line, part in zip(found, expected, strict=True):
        assert blob[line.byte :].startswith(part)
    assert [line.unterminated for line in found[:-1]] == [False] * (len(found) - 1)
    if found:
        assert found[-1].unterminated is not blob.endswith(b"\n")


@settings(deadline=None)
@given(st.lists(st.text("ab\r", max_size=5), min_size=1, max_size=30))
def test_line_at_is_that_line(parts: list[str]) -> None:
    blob = "".join(f"{part}\n" for part in parts).encode()
    for chunk in chunks(io.BytesIO(blob)):
        for index, line in enumerate(text_lines.chunk_lines(chunk)):
            assert line_at(chunk, index) == line


def test_a_line_without_end_takes_bounded_memory() -> None:
    class Endless:
        def __init__(self) -> None:
            self.given = 0

        def read(self, size: int, /) -> bytes:
            if self.given >= 200 << 20:
                return b""
            self.given += 1 << 20
            return b"\x00" * (1 << 20)

    longest = max(len(chunk.text) for chunk in chunks(Endless()))
    assert longest <= text_lines.LONGEST_LINE + 1


def test_lines_after_an_overlong_one_keep_their_numbers() -> None:
    blob = b"one\n" + b"x" * 300_000 + b"\nthree\n"
    found = list(lines(io.BytesIO(blob)))
    assert [(line.number, line.text[:5]) for line in found] == [
        (1, "one"),
        (2, "xxxxx"),
        (3, "three"),
    ]
    assert found[2].byte == blob.index(b"three")


@pytest.mark.parametrize("blob", [b"", b"\n"])
def test_hardly_any_text(blob: bytes) -> None:
    assert [line.text for line in lines(io.BytesIO(blob))] == [""] * len(blob)
