"""Model files: a parameter set extended by what was fitted.

Checked by: tests/unit/sil/inference/test_diagnose.py, tests/unit/sil/inference/identify/test_identify.py
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from plant.parameters import Parameter


def model_file(comment: str, base: str, sections: Mapping[str, Mapping[str, Parameter]]) -> str:
    """Return the text of a model file: a comment, the set it extends, sections of parameters."""
    lines = [f"# {comment}", "[base]", f"model = {json.dumps(base)}"]
    for section, table in sections.items():
        lines += ["", f"[{section}]", *(_line(name, item) for name, item in table.items())]
    return "\n".join(lines) + "\n"


def _line(name: str, item: Parameter) -> str:
    value = list(map(float, item.value)) if isinstance(item.value, tuple) else float(item.value)
    fields = {"value": value, "low": item.low, "high": item.high}
    numbers = ", ".join(f"{key} = {v!r}" for key, v in fields.items() if v is not None)
    unit, source = json.dumps(item.unit), json.dumps(item.source)
    return f"{name} = {{ {numbers}, unit = {unit}, source = {source} }}"
