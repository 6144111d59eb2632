"""The kinds of studies: one module each, with the keys, the rows and the figures of its kind."""

from sil.studies.kinds.bounds import BoundsStudy
from sil.studies.kinds.budget import BudgetStudy
from sil.studies.kinds.runs import RunsStudy
from sil.studies.kinds.sensitivity import SensitivityStudy
from sil.studies.kinds.stroke import StrokeStudy
from sil.studies.kinds.tuning import TuningStudy

StudyKind = RunsStudy | StrokeStudy | BudgetStudy | TuningStudy | SensitivityStudy | BoundsStudy
