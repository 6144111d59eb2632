"""The result of a run: result.json, which `opc4 run result.json` repeats from its `scenario`, and JUnit."""

from __future__ import annotations

import contextlib
import json
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import msgspec

from sil.files.atomic import write_atomically
from sil.files.output_folder import RESULT, finite
from sil.files.quantity import comparison
from sil.firmware.cost import Cost


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """One expectation after the run: its value in the run, and the limit."""

    name: str
    passed: bool
    value: Any
    limit: Any
    unit: str = ""

    def __str__(self) -> str:
        return comparison(self.name, self.value, self.limit, self.unit)


class Result(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=False):
    """Everything in result.json. `complete` is false when the run ended early; `why` says why."""

    format: int = 1
    scenario_name: str
    passed: bool = False
    complete: bool = False
    why: str | None = None
    expectations: list[Check] = []
    metrics: dict[str, Any] = {}
    trace_sha256: str | None = None
    seed: int
    transport: str
    versions: dict[str, str]
    bus: dict[str, Any] = {}
    balances: dict[str, Any] = {}
    firmware: Cost | None = None
    speed: dict[str, float] = {}
    scenario: Any
    """All that is stored to run again: every key with its value, also the seed and changes of the model. Files
    that it names (model_set, firmware, effects) are read again; effects must have the same content."""
    model: Any  # every parameter of the plant by path; not read again

    status: Literal["passed", "failed", "incomplete"] = "incomplete"
    warnings: list[str] = []  # what is likely to be a mistake in the scenario, with the cause
    changes: Any = None
    """What changed values change against a shipped scenario: `sil.simulation.compared.Changes`."""


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that a result depends on."""
    installed = {"python": platform.python_version()}
    for name in ("opc4-sil", "numpy", "numba", "scipy", "python-can", "cantools", "msgspec"):
        with contextlib.suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def as_json(result: Result) -> str:
    """Return the result as one JSON object, in the order of its fields."""
    return json.dumps(finite(msgspec.to_builtins(result)), indent=1, ensure_ascii=False)


def write_result(result: Result, folder: Path) -> None:
    """Write result.json atomically."""
    write_atomically(folder / RESULT, as_json(result) + "\n")


def junit_xml(result: Result) -> str:
    """Return a JUnit test suite: a case per expectation; a run that did not finish is one more, an error."""
    failed = [c for c in result.expectations if not c.passed]
    suite = ElementTree.Element(
        "testsuite",
        name=result.scenario_name,
        tests=str(len(result.expectations) + (not result.complete)),
        failures=str(len(failed)),
        errors=str(int(not result.complete)),
        skipped="0",
        time=f"{result.speed.get('wall_s', 0.0):.3f}",
    )

    def add(name: str, problem: str, message: str | None) -> None:
        case = ElementTree.SubElement(suite, "testcase", classname=result.scenario_name, name=name)
        if message is not None:  # without the control characters that XML 1.0 cannot hold
            text = "".join(c if c in "\t\n" or ord(c) >= 32 else "?" for c in message)
            ElementTree.SubElement(case, problem, message=text)

    for check in result.expectations:
        add(check.name, "failure", None if check.passed else str(check))
    if not result.complete:
        add("run finished", "error", result.why or "not finished")
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    text: str = ElementTree.tostring(root, encoding="unicode", xml_declaration=False)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + text + "\n"
