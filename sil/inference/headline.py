"""The one sentence that a reader needs first: causes and sizes as an engineer says them.

Checked by: tests/unit/sil/inference/test_headline.py
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from plant.effects import CATALOGUE
from sil.files.quantity import quantity
from sil.inference.thresholds import UNNAMED

if TYPE_CHECKING:
    from sil.inference.report import Interval, ReportedCause

FIRST_CLASSES = ("leak", "valve timing", "friction")
"""Classes of what would have been seen, those named first."""

_UNITS = {"s/Pa": (1e8, "ms/bar"), "m^2": (1e6, "mm²"), "m^3": (1e6, "cm³"), "": (100.0, "%")}


def sized(value: float, unit: str) -> str:
    """Return a value with its unit as it is said, two digits; one without a unit in per cent."""
    factor, unit = _UNITS.get(unit, (1.0, unit))
    value *= factor
    plain, _, shown = quantity(value, unit, 12).partition(" ")
    number = float(plain)
    text = f"{number:.0f}" if abs(number) >= 99.5 else f"{number:#.2g}".removesuffix(".")
    return f"{text} {shown}".rstrip()


def size_of(name: str, item: Interval) -> tuple[str, str]:
    """Return a parameter's value and its interval, e.g. "25 % lower" and "22 to 28 %"."""
    values, unit = [item.value, item.low, item.high], "" if item.unit == "-" else item.unit
    word = ""
    if name == "factor" and item.value > 2.0:
        return f"{item.value:#.2g} times the usual", f"{item.low:#.2g} to {item.high:#.2g} times"
    if name == "factor":
        sign = 1.0 if item.value > 1.0 else -1.0
        values, word = [sign * (v - 1.0) for v in values], " higher" if sign > 0.0 else " lower"
    value, *ends = values
    low, high = (sized(v, unit) for v in sorted(ends))
    left, _, same = low.partition(" ")
    if same == high.partition(" ")[2]:
        low = left
    return f"{sized(value, unit)}{word}", f"{low} to {high}"


def sentence_of(cause: ReportedCause) -> str:
    """Return what a cause means, with the size of its main parameter and that one's interval."""
    name, item = next(iter(cause.parameters.items()))
    text = CATALOGUE[cause.id].sentence if cause.id in CATALOGUE else ""
    if not text:
        text = f"{cause.what or cause.id.replace('_', ' ')}, {name.rpartition('_')[0] or name} {{}}"
    size, interval = size_of(name, item)
    return f"{text.format(size)} ({interval})"


def seen_sentence(sizes: Iterable[tuple[str, float, float, str]]) -> str:
    """Return what would have been seen of (id, value, neutral, unit); empty if nothing would."""
    of = {name: (value, neutral, unit) for name, value, neutral, unit in sizes}
    nouns = {
        item.id: item.noun
        for item in sorted(
            CATALOGUE.values(),
            key=lambda item: (*FIRST_CLASSES, item.cause_class).index(item.cause_class),
        )
        if item.noun
    } | {"stiffness": "a spring"}  # no effect of the catalogue
    names = [name for name in nouns if name in of][:3] or list(of)[:3]
    texts = []
    for name in names:
        value, neutral, unit = of[name]
        what = nouns.get(name, name.replace("_", " "))
        if neutral:
            texts.append(
                f"{what} above {'+' if value > neutral else ''}{sized(value / neutral - 1.0, '')}"
            )
        else:
            texts.append(f"{what} above {sized(abs(value), '' if unit == '-' else unit)}")
    if not texts:
        return ""
    text = f"{', '.join(texts)} would have been seen."
    return f"{text[0].upper()}{text[1:]}"


def headline(verdict: str, causes: Sequence[ReportedCause], seen: str, reason: str) -> str:
    """Return the one sentence that a reader needs first.

    seen: what would have been seen, as a sentence; reason: why nothing can be concluded.
    """
    if verdict == "cannot_tell":
        return f"These data cannot tell: {reason}."
    if verdict == "consistent":
        return f"Nothing found. {seen}".strip()
    if verdict == UNNAMED:
        where = next((c.what or c.cause_class for c in causes if c.id == UNNAMED), "")
        return f"Something is wrong: {where}; no cause of the catalogue fits."
    named = [cause for cause in causes if cause.id != UNNAMED]
    first, *others = map(sentence_of, named)
    joint = "; or " if verdict == "ambiguous" else "; and "
    text = joint.join([first, *(f"{other[0].lower()}{other[1:]}" for other in others)])
    text = f"{text[0].upper()}{text[1:]}"
    if len(named) < len(causes):
        text += ", besides something that no cause of the catalogue fits"
    return f"{text}."
