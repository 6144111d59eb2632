"""The generated tables of keys: complete, described, and what the records check."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import pytest

from docs.key_table import Key, describe
from sil.log_replay.signals import Options
from sil.simulation.scenario import Scenario
from sil.studies.study import StudyFile


@pytest.mark.parametrize(("record", "least"), [(Scenario, 200), (StudyFile, 20), (Options, 5)])
def test_no_key_lacks_a_description(record: type[msgspec.Struct], least: int) -> None:
    keys = describe(record)
    assert len(keys) >= least
    assert [(key.table, key.key) for key in keys if not key.description.strip()] == []
    assert len({(key.table, key.key) for key in keys}) == len(keys)


class Loss(msgspec.Struct, tag_field="kind", tag="loss"):
    """A frame is lost."""

    delay_s: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]
    """Time until it is."""


class Example(msgspec.Struct):
    """A table. size, load: how much."""

    size: Annotated[int, msgspec.Meta(ge=1)]
    load: float | None = None
    names: list[Literal["B", "N"]] = []
    """Names."""
    fault: list[Loss] = []
    """Faults."""


def test_rows_are_those_of_the_records() -> None:
    assert describe(Example) == [
        Key("", "size", "whole number", "", "required", "at least 1", "How much."),
        Key("", "load", "number", "", "none", "", "How much."),
        Key("", "names", "list of texts", "", "[]", '"B", "N"', "Names."),
        Key("", "fault", "list of tables", "", "[]", "", "Faults."),
        Key('[[fault]] kind = "loss"', "kind", "text", "", "required", '"loss"', "A frame is lost."),
        Key('[[fault]] kind = "loss"', "delay_s", "number", "s", "required",
            "above 0, at most 1", "Time until it is."),
    ]  # fmt: skip
