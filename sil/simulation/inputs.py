"""Everything that runs depend on, by content: what a resumed study or swarm has to have again."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from can_dbc.user_file import resolved
from plant.effects.user_file import MARK
from sil.simulation.results import versions

PACKAGES = ("can_dbc", "controller", "plant", "sil")


def input_digests(tables: Mapping[str, Any], folders: Sequence[Path]) -> dict[str, str]:
    """Return what decides runs, by name: a hash of each table's and file's content, or a version.

    tables: by the name that a message uses. Every text in them that names a file, in one of the folders,
    counts, with what such a TOML file names and what such a Python file imports from its own folders.
    """
    files = sorted(set(named_files(list(tables.values()), folders, set())))
    texts = {name: json.dumps(t, sort_keys=True, default=str) for name, t in tables.items()}
    digests = {name: _hash(text) for name, text in texts.items()}
    digests |= {str(path): _hash(path.read_bytes()) for path in files}
    return digests | {"the program": program_hash()} | versions()


def changed_inputs(before: dict[str, str], now: dict[str, str]) -> list[str]:
    """Return the names of what is not as it was before."""
    return sorted(name for name in before | now if before.get(name) != now.get(name))


def _hash(content: str | bytes) -> str:
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def program_hash() -> str:
    """Return the hash of this program's own files."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*")):
            if path.suffix in (".py", ".dbc", ".toml", ".c", ".h"):
                digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)
    elif isinstance(value, str) and len(value) < 1024 and value.isprintable():
        yield value


def named_files(value: Any, folders: Sequence[Path], passed: set[Path]) -> Iterator[Path]:
    """Yield the files that texts name, and those that these need; `passed`: those found before."""
    for text in _texts(value):
        name = text.partition(MARK)[0]
        for path in (
            folder / part for folder in folders for part in (name, name.rpartition(":")[0])
        ):
            path = resolved(path)
            if path in passed or not path.exists() or path == Path.cwd():
                continue
            passed.add(path)
            if path.is_dir() and (path / "controller" / "node.py").is_file():  # a checkout
                yield from (p for package in PACKAGES[:2] for p in (path / package).rglob("*.py"))
            elif path.is_file() and path.suffix:
                yield path
                yield from _needed_by(path, passed)


def _needed_by(path: Path, passed: set[Path]) -> Iterator[Path]:
    """Yield what a file refers to; a file that cannot be read is refused where it is used."""
    try:
        if path.suffix == ".toml":
            table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
            yield from named_files(table, (path.parent,), passed)
        elif path.suffix == ".py":
            yield from _imported(path, passed)
        elif path.suffix in (".c", ".h"):
            yield from path.parent.glob("*.[ch]")
    except (OSError, ValueError, SyntaxError):
        return


def _imported(path: Path, passed: set[Path]) -> Iterator[Path]:
    """Yield the files that a Python file imports, libraries and this program excepted."""
    libraries = ("site-packages", "dist-packages")
    own = [Path(entry) for entry in sys.path if Path(entry).name not in libraries]
    own = [folder for folder in own if not str(folder.resolve()).startswith(sys.base_prefix)]
    for node in ast.walk(ast.parse(path.read_bytes())):
        names, folders = [], [path.parent, *own]
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module or ''}.{alias.name}".strip(".") for alias in node.names]
            folders = [path.parents[node.level - 1]] if node.level else folders
        for parts in (name.split(".") for name in names if name.partition(".")[0] not in PACKAGES):
            stems = [f.joinpath(*parts[: k + 1]) for f in folders for k in range(len(parts))]
            files = [str(file) for s in stems for file in (f"{s}.py", s / "__init__.py")]
            yield from named_files(files, (Path(),), passed)
