"""Studies by name or file: read, checked, with the scenario that they start from.

Checked by: tests/unit/sil/studies/test_whatif.py
"""

from __future__ import annotations

from pathlib import Path

from can_dbc.errors import InputError
from sil.files import typed_toml
from sil.studies.study import Base, LoadedStudy, Study
from sil.studies.study_checks import check_metrics, check_study

SHIPPED = Path(__file__).parent / "shipped"


def shipped() -> dict[str, Path]:
    """The studies that come with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def load_study(where: str) -> LoadedStudy:
    """Read a study file, or a shipped study by name.

    Raises InputError naming file, place, what is wrong and what was expected.
    """
    path = Path(where)
    if not where.endswith(".toml"):
        known = shipped()
        if where not in known:
            import difflib

            near = difflib.get_close_matches(where, known, n=3, cutoff=0.3) or list(known)
            raise InputError(f"study {where!r}: no such study; nearest: {', '.join(near)}")
        path = known[where]
    study = typed_toml.convert(typed_toml.read_toml(path), Study, str(path))
    check_study(study, str(path))
    loaded = LoadedStudy(study, str(path), base_of(study, path))
    check_metrics(loaded)
    return loaded


def base_of(study: Study, path: Path) -> Base | None:
    """The scenario that a study names: a file beside the study's, else a shipped one."""
    if study.scenario is None:
        return None
    from sil.simulation import scenario

    beside = path.parent / study.scenario
    try:
        where = str(beside) if beside.is_file() else study.scenario
        table, found = scenario.read(where)
    except InputError as error:
        raise InputError(f"{path}: scenario: {error}") from None
    return Base(table, str(found), str(found.parent))
