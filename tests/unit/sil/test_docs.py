"""The documentation: the reference is what the code says, links lead somewhere, commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from can_dbc.contract import contract
from docs.generate_reference import PAGE, reference
from sil import cli
from sil.claims.claim import all_claims
from sil.simulation.scenario import shipped as scenarios
from sil.studies.load_study import shipped as studies
from tests.conftest import ROOT

DOCS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
NAMES = [path.relative_to(ROOT).as_posix() for path in DOCS]


def prose(path: Path) -> str:
    """The text without its blocks of code."""
    return re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchors(path: Path) -> set[str]:
    heads = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_the_reference_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == reference(), "run: python -m docs.generate_reference"


def test_the_reference_has_all_messages_and_commands() -> None:
    text = PAGE.read_text(encoding="utf-8")
    heads = set(re.findall(r"^### (.*)$", text, re.MULTILINE))
    assert {message.name for message in contract().messages} <= heads
    assert {f"`opc4 {name}`" for name in cli.COMMANDS} <= heads


@pytest.mark.parametrize("path", DOCS, ids=NAMES)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        assert "://" not in target, target
        place, _, anchor = target.partition("#")
        file = (path.parent / place) if place else path
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def test_the_docs_have_links() -> None:
    assert sum(len(re.findall(r"\]\(([^)\s]+)\)", prose(path))) for path in DOCS) >= 8


@pytest.mark.parametrize("path", DOCS, ids=NAMES)
def test_commands_in_the_text_exist(path: Path) -> None:
    """Also those that take hours: the command, the shipped study or scenario, the claim."""
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"\bopc4 ([a-z]+)\b", text):
        assert name in cli.COMMANDS, name
    for name in re.findall(r"`opc4 whatif ([a-z_]+)[` ]", text):
        assert name in studies(), name
    for name in re.findall(r"`opc4 run ([a-z_0-9]+)[` ]", text):
        assert name in scenarios(), name
    claims = {claim.id for claim in all_claims()}
    for ids in re.findall(r"`opc4 claims ((?:F\d+\w* ?)+)`", text):
        assert set(ids.split()) <= claims
    for module in re.findall(r"python -m ([a-z_.]+)", text):
        places = [
            ROOT / Path(*module.split(".")).with_suffix(".py"),
            ROOT / Path(*module.split(".")),
        ]
        assert any(place.exists() for place in places), module


def test_files_that_the_theory_names_exist() -> None:
    text = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    files = set(re.findall(r"\b(?:plant|tests|sil|controller)/[\w/]+\.\w+", text))
    assert len(files) > 10
    assert [name for name in sorted(files) if not (ROOT / name).exists()] == []


def test_every_equation_that_the_plant_cites_is_in_the_theory() -> None:
    theory = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")

    def covered(text: str) -> set[int]:
        found: set[int] = set()
        for low, high in re.findall(r"\b3\.(\d\d?)(?:-3\.(\d\d?))?(?![\d.])", text):
            found |= set(range(int(low), int(high or low) + 1))
        return found

    cited: set[int] = set()
    for path in (ROOT / "plant").rglob("*.py"):
        for docstring in re.findall(r'"""(.*?)"""', path.read_text(encoding="utf-8"), re.DOTALL):
            if "hesis" in docstring or "(3." in docstring:
                cited |= covered(" ".join(re.findall(r"3\.\d\d[\d./,\- ]*", docstring)))
    assert len(cited) > 15
    assert cited <= covered(theory), sorted(cited - covered(theory))


def test_what_docstrings_say_they_are_checked_by_exists() -> None:
    tests = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    for path in (ROOT / "tests").rglob("test_*.py"):
        tests |= set(re.findall(r"def (test_\w+)", path.read_text(encoding="utf-8")))
    missing, named = [], 0
    for package in ("can_dbc", "controller", "plant", "sil"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for claim in re.findall(r"[Cc]hecked by:? ([^)]*?)(?:\.\s|\.?\"\"\"|\n\n)", text):
                for place in re.findall(r"tests/[\w/]+(?:\.py)?", claim):
                    named += 1
                    missing += [f"{path}: {place}"] * (not (ROOT / place).exists())
                for name in re.findall(r"(?<![\w/])test_\w+", claim):
                    named += 1
                    missing += [f"{path}: {name}"] * (name not in tests)
    assert named > 100
    assert missing == []
