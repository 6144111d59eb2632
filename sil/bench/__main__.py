"""python -m sil.bench [NAME...]: run the named measurements; none: all that take minutes."""

from __future__ import annotations

import importlib
import pkgutil
import sys

import sil.bench

HOURS = ("hidden_effects", "soak")


def main(wanted: list[str]) -> int:
    """Run measurements by the name of their module; each has `measure() -> lines of text`."""
    known = sorted(item.name for item in pkgutil.iter_modules(sil.bench.__path__))
    known = [name for name in known if not name.startswith("_")]
    for name in wanted:
        if name not in known:
            print(f"sil.bench: no measurement {name!r}; there are {', '.join(known)}", file=sys.stderr)
            return 2
    for name in wanted or [name for name in known if name not in HOURS]:
        print(f"## {name}")
        for line in importlib.import_module(f"sil.bench.{name}").measure():
            print(line, flush=True)
        print()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
