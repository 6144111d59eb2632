"""report.html of a diagnosis."""

from __future__ import annotations

from pathlib import Path

from .diagnosis import Diagnosis


def write_report(result: Diagnosis, path: Path, campaign: str, model: str) -> None:
    """Write the page."""
    path.write_text("<!doctype html><title>diagnosis</title>", encoding="utf-8")
