"""Check the thesis's claims: claimed, achieved, met or not."""

from __future__ import annotations

import argparse
import json
import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from sil.cli.options import JSON, argument

if TYPE_CHECKING:
    from sil.claims.claim import Claim

EXAMPLE = "example: opc4 claims F07 F16 F36"


ARGUMENTS = (
    argument("id", "claims to check (default: all)", "ID", nargs="*"),
    argument("--out", "folder for claims.json, claims.md, report.html", "DIR", type=Path),
    argument("--force", "replace claims in DIR"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Check and print; 0 also when a claim is not met: that is an answer."""
    from sil.claims.claim import check, chosen
    from sil.claims.page import write_page
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import prepare_folder

    wanted = chosen(arguments.id)
    folder = None
    if arguments.out is not None:
        folder = prepare_folder(arguments.out, "claims", arguments.force)
    found: list[Claim] = []
    for item in wanted:
        finding = check(item)
        found.append(finding)
        if not arguments.json:
            print(f"{finding.id:5} {finding.verdict:15} {finding.claimed}")
            print(f"      {finding.achieved}")
            if finding.reason:
                print(f"      because: {finding.reason}")
            if finding.changed:
                print(f"      judged anew: {finding.changed}")
            print(f"      shown by: {finding.command}")
    counts = Counter(finding.verdict for finding in found)
    table = {
        "claims": [msgspec.to_builtins(finding) for finding in found],
        "verdicts": dict(counts),
    }
    if folder is not None:
        write_atomically(folder / "claims.md", markdown(found))
        write_page(found, folder, shlex.join(["opc4", "claims", *arguments.id]))
        write_atomically(
            folder / "claims.json", json.dumps(table, indent=1, ensure_ascii=False) + "\n"
        )
    if arguments.json:
        print(json.dumps(table, ensure_ascii=False))
    else:
        print(", ".join(f"{number} {verdict}" for verdict, number in counts.most_common()))
    return 0


def markdown(found: list[Claim]) -> str:
    """Return the findings as one Markdown table."""
    lines = [
        "| claim | section | the thesis | here | verdict | shown by |",
        "|---|---|---|---|---|---|",
    ]
    for item in found:
        why = f" ({item.reason})" if item.reason else ""
        why += f" *Judged anew: {item.changed}*" if item.changed else ""
        cells = [item.id, item.section, item.claimed, item.achieved + why, item.verdict]
        cells = [cell.replace("|", "\\|") for cell in cells]
        lines.append("| " + " | ".join(cells) + f" | `{item.command}` |")
    return "\n".join(lines) + "\n"
