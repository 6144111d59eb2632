"""Drafts of a user's own files: `--new FILE` writes one, commented, that runs as it is."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sil.cli.options import argument

NEW = argument("--new", "write a commented draft that runs as it is, and do nothing else", "FILE", type=Path)  # fmt: skip


def write_draft(command: str, arguments: argparse.Namespace, then: str) -> int:
    """Write the draft of a command's file to `arguments.new`; `then` is the command to type next.

    Raises InputError for a suffix without a draft, and for a file that exists, without --force.
    """
    from can_dbc.errors import InputError
    from sil.files.atomic import write_atomically
    from sil.files.overrides import toml_value

    path: Path = arguments.new
    shipped = sorted((Path(__file__).parent / "drafts").glob(f"{command}.*"))
    drafts = {draft.suffix: draft for draft in shipped}
    if path.suffix not in drafts:
        expected = " or ".join(f"FILE{suffix}" for suffix in drafts)
        raise InputError(f"{path}: --new: no draft of such a file; expected {expected}")
    if path.exists() and not arguments.force:
        raise InputError(f"{path}: --new: exists; expected a new file, or --force")
    if not path.parent.is_dir() or path.is_dir():
        raise InputError(f"{path}: --new: no such folder; expected a file in one that exists")
    text = drafts[path.suffix].read_text(encoding="utf-8")
    text = text.replace("THIS_FILE", str(path)).replace('"draft"', toml_value(path.stem[:80]))
    write_atomically(path, text)
    if arguments.json:
        print(json.dumps({"file": str(path), "then": then}, ensure_ascii=False))
    else:
        print(f"{path}: a draft that runs as it is: {then}")
    return 0
