"""One row of a study: its figures, whether it passed, and why not.

A module of `sil.studies.kinds` makes the rows of each kind of study.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from can_dbc.errors import InputError, RunError
from sil.studies.study import LoadedStudy, Row

if TYPE_CHECKING:
    from sil.report.figure import Figure
    from sil.studies.table import Table

PASSED: Literal["passed"] = "passed"
FAILED: Literal["failed"] = "failed"
NOT_RUN: Literal["not run"] = "not run"
OUTCOMES = (PASSED, FAILED, NOT_RUN)


@dataclass(frozen=True)
class RowResult:
    """Figures of one row by column, its outcome, and the reason where it did not pass.

    failed: the row ran and did not meet what is expected of it. not run: a participant died or the
    equations could not be solved. Figures that a row does not have are NaN.
    """

    figures: Mapping[str, float]
    outcome: Literal["passed", "failed", "not run"] = PASSED
    reason: str = ""


class StudyKind(Protocol):
    """A module that makes and draws the rows of one kind of study."""

    def columns(self, study: LoadedStudy) -> tuple[str, ...]:
        """Return the names of the figures of each row."""

    def run(self, study: LoadedStudy, row: Row) -> RowResult:
        """Run one row. Raises InputError for wrong settings, RunError if it cannot finish."""

    def figures(self, study: LoadedStudy, table: Table) -> dict[str, Figure]:
        """Return the figures of a finished study by file name.

        A kind may also have `files` with the same arguments: it yields names and texts of more files.
        """


def kind_of(study: LoadedStudy) -> StudyKind:
    """Return the module that makes the rows of a study."""
    name: str = study.study.kind
    if name == "runs":
        name = "closed_loop" if study.study.stroke is None else "stroke"
    found: StudyKind = importlib.import_module(f"sil.studies.kinds.{name}")
    return found


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the names of the figures of each row of a study."""
    return kind_of(study).columns(study)


def more_files(study: LoadedStudy, table: Table) -> Iterable[tuple[str, str]]:
    """Return names and texts of the files that only this kind of study writes."""
    files = getattr(kind_of(study), "files", None)
    found: Iterable[tuple[str, str]] = files(study, table) if files is not None else ()
    return found


def run_row(study: LoadedStudy, row: Row) -> RowResult:
    """Run one row; a row that cannot finish is returned with its reason.

    Raises InputError, naming the row, for settings that no model or scenario accepts.
    """
    try:
        return kind_of(study).run(study, row)
    except InputError as error:
        raise InputError(f"{study.source}: row {row.number}: {error}") from None
    except RunError as error:
        nothing = dict.fromkeys(columns(study), math.nan) | {"failed": 1.0}
        return RowResult(nothing, NOT_RUN, " ".join(str(error).split()))
