"""List the shipped examples, or copy one into a folder: files to start from, each with its commands.

All their data were made by the simulator; README.md of each says how.

example:
  opc4 example
  opc4 example truck --out mine
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from can_dbc.errors import InputError, nearest
from sil.cli.options import JSON, argument

ARGUMENTS = (
    argument("name", "the example to copy", "NAME", nargs="?"),
    argument("--out", "folder for its files, made if missing [NAME]", "DIR", type=Path),
    argument("--force", "replace files of the same name"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """List or copy. Raises InputError for an example that is not there, or a file that is."""
    from sil.files.atomic import write_atomically

    shipped = Path(__file__).parent.parent / "examples"
    examples = {path.parent.name: path.parent for path in sorted(shipped.glob("*/README.md"))}
    if arguments.name is None:
        titles = {name: _readme(folder).split("\n", 1)[0] for name, folder in examples.items()}
        lines = [f"{name:<10} {title}" for name, title in titles.items()]
        print(json.dumps({"examples": titles}) if arguments.json else "\n".join(lines))
        return 0
    if arguments.name not in examples:
        expected = ", ".join(nearest(arguments.name, examples) or examples)
        raise InputError(f"no example {arguments.name!r}; expected one of {expected}")
    source = examples[arguments.name]
    files = sorted(path.relative_to(source) for path in source.rglob("*.*") if path.is_file())
    out = arguments.out or Path(arguments.name)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: --out: is a file; expected a folder")
    for file in files:
        if (out / file).exists() and not arguments.force:
            raise InputError(f"{out / file}: exists; expected a new folder, or --force")
    for file in files:
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out / file, (source / file).read_bytes())
    if arguments.json:
        print(json.dumps({"folder": str(out), "files": list(map(str, files))}))
    else:
        print(f"{out}: {' '.join(map(str, files))}\n\n{_readme(out)}", end="")
    return 0


def _readme(folder: Path) -> str:
    return (folder / "README.md").read_text(encoding="utf-8")
