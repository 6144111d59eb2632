"""The documentation builds without a warning, is up to date, and names only what exists."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs.generate import FOLDER, examples, generated
from sil import cli
from sil.simulation.load_scenario import from_table
from sil.simulation.load_scenario import shipped as scenarios
from sil.studies.load_study import read_file
from sil.studies.load_study import shipped as studies
from tests.conftest import ROOT
from tests.docs.pages import DOCS, PAGES, prose


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            *(sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going"),
            *("-d", tmp_path / "trees", DOCS, tmp_path / "site"),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert (tmp_path / "site" / "reference" / "python.html").stat().st_size > 20_000


def test_generated_files_are_up_to_date() -> None:
    made = generated()
    assert len(made) >= 3
    for name, text in made.items():
        stored = (FOLDER / name).read_text(encoding="utf-8")
        assert stored == text, f"{name}: run `python -m docs.generate`"


@pytest.mark.parametrize("table", examples()["scenario"])
def test_examples_of_scenario_keys_are_accepted(table: str) -> None:
    start = {"name": "example", "duration_s": 1.0, "request": [{"at_s": 0.1, "gear": "backward"}]}
    example = tomllib.loads(examples()["scenario"][table])
    example.pop("firmware", None)  # a file of the reader's
    from_table({**start, **example}, table)


@pytest.mark.parametrize("table", examples()["study"])
def test_examples_of_study_keys_are_accepted(table: str) -> None:
    start = {"name": "example", "scenario": "lab_n_b", "reads": ["shift_time_s"]}
    example = tomllib.loads(examples()["study"][table])
    if "stroke" in example:
        del start["scenario"]
    read_file({**start, **example}, table)


def test_the_readme_is_one_page() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 800


def test_the_readme_links_every_guide_and_the_glossary() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = [*(ROOT / "docs" / "how-to").glob("*.md"), ROOT / "docs" / "reference" / "glossary.md"]
    missing = [page.name for page in pages if f"({page.relative_to(ROOT)})" not in text]
    assert len(pages) > 15 and missing == []


GENERATED = ("cli", "can", "keys", "firmware", "rules", "python")
LIMITS = {"docs/how-to": 700, "docs/explanation": 1500}
"""Most words of a page, by folder."""


def test_pages_are_short() -> None:
    words = {page: len(path.read_text(encoding="utf-8").split()) for page, path in PAGES.items()}
    for page, count in words.items():
        assert count <= LIMITS.get(page.rpartition("/")[0], 2100) or Path(page).stem in (
            *GENERATED,
            "claims",
        ), page
    ours = {p: n for p, n in words.items() if Path(p).stem not in (*GENERATED, "claims")}
    assert sum(ours.values()) <= 25_000


def anchors(path: Path) -> set[str]:
    heads = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(PAGES[page])):
        assert "://" not in target, target
        name, _, anchor = target.partition("#")
        file = (PAGES[page].parent / name) if name else PAGES[page]
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def test_every_page_is_reachable_from_the_index() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    for path in DOCS.rglob("*.md"):
        name = path.relative_to(DOCS).with_suffix("").as_posix()
        assert name == "index" or re.search(rf"^{name}$", index, re.MULTILINE), name


@pytest.mark.parametrize("page", PAGES)
def test_names_in_the_text_exist(page: str) -> None:
    """Commands, shipped studies and scenarios, claims, modules and files."""
    text = PAGES[page].read_text(encoding="utf-8")
    for name in re.findall(r"\bopc4 ([a-z]+)\b", text):
        assert name in cli.COMMANDS, name
    for name in re.findall(r"`opc4 whatif ([a-z_]+)[` ]", text):
        assert name in studies(), name
    for name in re.findall(r"`opc4 run ([a-z_0-9]+)[` ]", text):
        assert name in scenarios(), name
    for module in re.findall(r"python -m ([a-z_.]+[a-z_])", text):
        if module.partition(".")[0] in ("can_dbc", "controller", "plant", "sil", "tests"):
            path = ROOT / Path(*module.split("."))
            assert path.exists() or path.with_suffix(".py").exists(), module
    for name in re.findall(r"`((?:can_dbc|controller|plant|sil|tests|docs)/[\w/.-]*)`", text):
        if not re.search(r"[A-Z]{4}", name):  # NAME and PACKAGE are the reader's
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_imports_in_the_text_exist(page: str) -> None:
    text = PAGES[page].read_text(encoding="utf-8")
    pattern = r"^from ((?:can_dbc|controller|plant|sil)[\w.]*) import (\([^)]*\)|[^\n]+)"
    for module, names in re.findall(pattern, text, re.MULTILINE):
        found = importlib.import_module(module)
        for name in re.findall(r"\w+", names.partition("#")[0]):
            assert hasattr(found, name), f"{module}.{name}"


def test_functions_of_the_architecture_exist_and_its_tour_reads_at_most_1000_lines() -> None:
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|([^|\n]*\|)? `([\w/]+\.py)` \| `([\w.]+)` \|", text, re.MULTILINE)
    tour = 0
    for question, file, name in rows:
        node: ast.AST = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        for part in name.split("."):
            found = [n for n in ast.walk(node) if getattr(n, "name", None) == part]
            assert found, f"{file}: no {name}"
            node = found[0]
        assert isinstance(node, ast.FunctionDef), f"{file}: {name}"
        if not question:
            tour += (node.end_lineno or 0) - node.lineno + 1
    assert len(rows) > 40
    assert 400 < tour <= 1000, tour


def test_every_equation_that_the_plant_cites_is_in_the_theory() -> None:
    theory = (DOCS / "explanation" / "theory.md").read_text(encoding="utf-8")

    def numbers(text: str) -> set[int]:
        found: set[int] = set()
        for low, high in re.findall(r"\b3\.(\d\d?)(?:-3\.(\d\d?))?(?![\d.])", text):
            found |= set(range(int(low), int(high or low) + 1))
        return found

    cited: set[int] = set()
    for path in (ROOT / "plant").rglob("*.py"):
        for docstring in re.findall(r'"""(.*?)"""', path.read_text(encoding="utf-8"), re.DOTALL):
            if "hesis" in docstring or "(3." in docstring:
                cited |= numbers(" ".join(re.findall(r"3\.\d\d[\d./,\- ]*", docstring)))
    assert len(cited) > 15
    assert cited <= numbers(theory), sorted(cited - numbers(theory))


def test_tests_that_docstrings_name_exist() -> None:
    tests = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    for path in (ROOT / "tests").rglob("test_*.py"):
        tests |= set(re.findall(r"def (test_\w+)", path.read_text(encoding="utf-8")))
    missing: list[str] = []
    for package in ("can_dbc", "controller", "plant", "sil"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for claim in re.findall(r"[Cc]hecked by:? ([^)]*?)(?:\.\s|\.?\"\"\"|\n\n)", text):
                for name in re.findall(r"tests/[\w/]+(?:\.py)?", claim):
                    missing += [f"{path}: {name}"] * (not (ROOT / name).exists())
                for name in re.findall(r"(?<![\w/])test_\w+", claim):
                    missing += [f"{path}: {name}"] * (name not in tests)
    assert missing == []
