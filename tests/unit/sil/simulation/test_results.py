"""Run folders, result.json and JUnit."""

from __future__ import annotations

import json
from xml.etree import ElementTree

from sil.files.output_folder import finite
from sil.simulation.results import Check, as_json, junit_xml, versions
from tests.support.results import finished_result


def test_json_has_no_nan_and_the_promised_names() -> None:
    output = json.loads(
        as_json(finished_result(metrics={"a": float("nan"), "b": [float("inf"), 1.0]}))
    )
    assert output["metrics"] == {"a": None, "b": [None, 1.0]}
    assert {
        "passed",
        "expectations",
        "metrics",
        "trace_sha256",
        "seed",
        "versions",
        "scenario",
    } <= (output.keys())
    assert finite({1: (float("-inf"), "x")}) == {"1": [None, "x"]}


def test_versions_name_the_libraries_a_result_depends_on() -> None:
    assert {"python", "numpy", "numba", "python-can"} <= versions().keys()


def test_junit_counts_failures_and_an_unfinished_run() -> None:
    bad = Check(name='<a> & "b"', passed=False, value=None, limit={"max": 1.0})
    text = junit_xml(
        finished_result(expectations=[*finished_result().expectations, bad], passed=False)
    )
    suite = ElementTree.fromstring(text.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    assert [c.get("name") for c in suite] == ["final gear", '<a> & "b"']
    ended = junit_xml(finished_result(complete=False, why="plant was killed\x00", passed=False))
    suite = ElementTree.fromstring(ended.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("errors")) == ("2", "1")
    error = suite.find("testcase[@name='run finished']/error")
    assert error is not None and error.get("message") == "plant was killed?"
