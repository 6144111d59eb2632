"""One look for all pages: a shell, one style sheet, one plot layer; a page is one file, offline."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sil.files.quantity import limits, quantity
from sil.report.plots import PlotGroup
from sil.report.theme import THEMES

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Picture:
    """A picture on a page: PNG bytes, what it shows for those who cannot see it, a caption."""

    png: bytes
    alt: str
    caption: str

    @property
    def source(self) -> str:
        """The picture as an address that needs no network."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()

    @property
    def wide(self) -> bool:
        """Whether letters become too small when it is shrunk to a phone: moved sideways instead."""
        return int.from_bytes(self.png[16:20], "big") > 1000  # pixels


@dataclass(frozen=True)
class Head:
    """What is at the top of every page.

    command: the `opc4` command it is of. good: whether the verdict is a good one; None: neither.
    tiles: figures as (value, name). again: the call that makes the page again.
    """

    command: str
    name: str
    verdict: str = ""
    good: bool | None = None
    tiles: Sequence[tuple[str, str]] = ()
    again: str = ""


def render(template: str, head: Head, groups: Sequence[PlotGroup] = (), **values: Any) -> str:
    """Return a page: `template` extends shell.html and finds `head`, `groups` and the values."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    trims: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True}
    loader = FileSystemLoader(HERE)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, **trims)
    environment.filters |= {
        "quantity": quantity,
        "limits": limits,
        "number": number,
        "ms": milliseconds,
        "ms3": partial(milliseconds, digits=3),
    }
    values |= {"head": head, "groups": groups, "library": _library() if groups else None}
    return environment.get_template(template).render(values)


def _library() -> dict[str, str]:
    """Return what plots need in the page, once."""
    uplot = (HERE / "uplot" / "uPlot.min.js").read_text(encoding="utf-8")
    return {
        # its banner names its home; a page without any address clearly needs no network
        "uplot": uplot.replace("https://", ""),
        "style": (HERE / "uplot" / "uPlot.min.css").read_text(encoding="utf-8"),
        "script": (HERE / "plots.js").read_text(encoding="utf-8"),
        "themes": json.dumps(THEMES, separators=(",", ":")),
    }


def number(value: float | None) -> str:
    """Return a number with three significant digits."""
    return "none" if value is None else f"{value:.3g}"


def milliseconds(value: float | None, digits: int = 1) -> str:
    """Return seconds as milliseconds."""
    return "none" if value is None else f"{1e3 * value:.{digits}f}"
