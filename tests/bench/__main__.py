"""Measurements compared with other tools: python -m tests.bench [NAME...]; no name: all that take minutes."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from types import ModuleType

import tests.bench

SUPPORT = {
    "hidden_effects": "hidden_study",
    "instruments": "instruments",
    "next_experiment": "next_strokes",
    "replay": "replay_cost",
    "strategies": "step_cost",
}
"""Measurements that tests use too: their module in tests/support."""

HOURS = ("hidden_effects", "instruments", "second_cylinder", "soak", "truck_sets")


def module(name: str) -> ModuleType:
    """The module of a measurement."""
    place = f"support.{SUPPORT[name]}" if name in SUPPORT else f"bench.{name}"
    return importlib.import_module(f"tests.{place}")


def main(wanted: list[str]) -> int:
    """Run measurements by the name of their module; each has `measure() -> lines of text`."""
    names = {item.name for item in pkgutil.iter_modules(tests.bench.__path__)}
    known = sorted(name for name in {*names, *SUPPORT} if not name.startswith("_"))
    if {"-h", "--help"} & set(wanted):
        print("usage: python -m tests.bench [NAME...]    (no name: all that take minutes)")
        for name in known:
            text = module(name).__doc__ or ""
            print(f"  {name:16} {text.split(chr(10), 1)[0]}{'  (hours)' if name in HOURS else ''}")
        return 0
    for name in wanted:
        if name not in known:
            print(
                f"tests.bench: no measurement {name!r}; there are {', '.join(known)}",
                file=sys.stderr,
            )
            return 2
    for name in wanted or [name for name in known if name not in HOURS]:
        print(f"## {name}")
        for line in module(name).measure():
            print(line, flush=True)
        print()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
