"""The diagnosis of a campaign with rig = "force", from its folder."""

from __future__ import annotations

from pathlib import Path

from sil.inference.force.diagnosis import ForceDiagnosis, diagnose_motion
from sil.inference.force.record import read_motion


def diagnose_force(path: Path) -> ForceDiagnosis:
    """Return the diagnosis of the campaign in a folder."""
    return diagnose_motion(read_motion(path))
