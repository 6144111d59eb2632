"""Rows that weigh assumptions: by how much each headline holds under other inferred numbers.

A row sets parameters of the model, `factor.NAME` (`sil.studies.assumptions`), `stroke.NAME`
(`RowConditions` of headlines), and filter and latency of the runs. Figures are margins, positive where the
headline holds. Designs: `one_at_a_time` gives the range in which it holds; `radial` Sobol's total indices
by Jansen's estimator, with bootstrapped intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from can_dbc import typed_toml
from can_dbc.errors import InputError
from plant.parameters import Number, load
from sil.recording.runs import true_runs
from sil.report.figure import Figure, Panel, Rule, Span, Stack
from sil.studies.assumptions import FACTORS, NOT_VARIED
from sil.studies.figures import metric_of, numbered, title_of
from sil.studies.kinds.headlines import Case, Headline, RowConditions, shipped_headlines
from sil.studies.study import RowResult, Setting, Study, StudyFile, StudyRow, Table
from sil.studies.table import markdown

Floats = NDArray[np.float64]


class SensitivityStudy(StudyFile, frozen=True, kw_only=True, tag_field="kind", tag="sensitivity"):
    """A row is the margins of the headlines of "Why feedback fails" under other inferred numbers."""

    leave_out: tuple[str, ...] = ()
    """Headlines that are not weighed."""

    @property
    def headlines(self) -> list[Headline]:
        """The headlines that are weighed."""
        return [each for each in shipped_headlines() if each.name not in self.leave_out]

    @property
    def radial(self) -> bool:
        """Whether indices are drawn, not ranges."""
        return self.design.kind == "radial"

    def check(self, source: str) -> None:
        """Refuse conditions below their least value. Raises InputError."""
        swept = [(each.path, x) for each in self.sweep for x in each.values or each.ends]
        choices = [choice for group in self.groups.values() for choice in group]
        chosen = [pair for choice in choices for pair in choice.set.items()]
        for path, value in (*swept, *chosen):
            group, _, name = path.partition(".")
            if group == "stroke":
                typed_toml.convert({name: value}, RowConditions, source, "stroke")

    def columns(self) -> tuple[str, ...]:
        """Return the margins of the headlines."""
        return (*(headline.name for headline in self.headlines), "failed")

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Return each headline's margin. Raises InputError, or RunError if no solution is found."""
        case = self._case(row)
        margins = {headline.name: case.margin(headline) for headline in self.headlines}
        missing = [name for name, margin in margins.items() if not math.isfinite(margin)]
        if missing:
            figures = margins | {"failed": 1.0}
            return RowResult(figures, "not run", f"no value of {', '.join(missing)}")
        return RowResult(margins | {"failed": 0.0})

    def _case(self, row: StudyRow) -> Case:
        factors: dict[str, float] = {}
        conditions: dict[str, float] = {}
        model: dict[str, Number] = {}
        settings: dict[str, Setting] = {}
        for path, value in row.settings.items():
            if isinstance(value, (bool, str, list)):
                raise InputError(f"{path}: {value!r}; expected a number")
            group, _, name = path.partition(".")
            if group == "factor":
                factors[name] = value
            elif group == "stroke":
                conditions[name] = value
            elif group in ("controller", "sensor"):
                settings[path] = value
            else:
                model[path] = float(value)
        for name, factor in factors.items():
            if name not in FACTORS:
                raise InputError(f"factor.{name}: unknown; expected one of {', '.join(FACTORS)}")
            if not factor > 0.0:
                raise InputError(f"factor.{name}: {factor:g}; expected above 0")
        parameters = load(self.model).override(model)
        for name, change in FACTORS.items():
            if factors.get(name, 1.0) != 1.0:
                model |= change(parameters, factors[name])
                parameters = parameters.override(model)
        under = typed_toml.convert(conditions, RowConditions, key="stroke")
        return Case(self.model, parameters, {**settings, **model}, under)

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return for each headline its margin over each parameter, or the total index of each."""
        ticks, zero = (
            numbered([each.title for each in self.sweep]),
            Rule(0.0, "", "ink", "x", "solid"),
        )
        limits, height = (len(ticks) - 0.5, -0.5), 60 + 14 * len(ticks)
        stacks = []
        for headline in self.headlines:
            spans = [
                Span(low, max(high, low + 1e-3), role, "", k - 0.3, k + 0.3)
                for k, (low, high, _cell) in enumerate(self._weighed(table, headline.name))
                if math.isfinite(high)
                for role in ("series0" if low > 0.0 else "alarm",)
            ]
            panel = Panel(
                headline.text, spans=spans, rules=[zero], ticks=ticks, limits=limits, height=height
            )
            axis = f"margin of the headline, {metric_of(headline.name).unit}"
            axis = "total Sobol index, 95 % interval" if self.radial else axis
            stacks.append(Stack(axis, [panel], width=5.2))
        note = "blue: the headline holds over the whole range; red: it turns"
        return {"sensitivity": Figure(stacks, title_of(study), "" if self.radial else note)}

    def texts(self, study: Study, table: Table) -> dict[str, str]:
        """Return the tables of parameters and headlines, and the parameters that are not in them."""
        lines = []
        for k, headline in enumerate(self.headlines, 1):
            _, unit, factor = metric_of(headline.name)
            margin = table.numbers[headline.name][0]
            nominal = "" if self.radial else f"{factor * margin:.{_digits(unit)}f} "
            lines.append(f"{k}. {headline.text}: {nominal}{unit}")
        columns = [
            [cell for _low, _high, cell in self._weighed(table, headline.name)]
            for headline in self.headlines
        ]
        rows = []
        for k, sweep in enumerate(self.sweep):
            over = f": {min(sweep.values):g} to {max(sweep.values):g}" if sweep.values else ""
            rows.append([f"{sweep.title}{over}", *(column[k] for column in columns)])
        parts = {"turns a headline": True, "turns none": False}
        if self.radial:
            parts = {"total index (95 % interval)": False}
        for what, turning in parts.items():
            head = [what, *map(str, range(1, len(columns) + 1))]
            chosen = [row for row in rows if ("**" in "".join(row)) == turning]
            lines += ["", *markdown(head, chosen)]
        lines += ["", "Not varied:", ""]
        lines += [f"- {', '.join(paths)}: {reason}" for reason, paths in NOT_VARIED.items()]
        return {"sensitivity.md": "\n".join(lines) + "\n"}

    def _weighed(self, table: Table, name: str) -> Iterator[tuple[float, float, str]]:
        """Yield the ends of each swept value's influence (margins, or the index), and that in words."""
        margins = table.numbers[name]
        if self.radial:
            for index, low, high in total_indices(margins, len(self.sweep)):
                yield low, high, f"{index:.2f} ({low:.2f} to {high:.2f})"
            return
        swept = np.array([table.numbers[sweep.path] for sweep in self.sweep])
        _, unit, factor = metric_of(name)
        for k, values in enumerate(swept):
            alone = (np.delete(swept, k, axis=0) == np.delete(swept[:, :1], k, axis=0)).all(axis=0)
            shown = factor * margins[alone]
            ran = shown[np.isfinite(shown)]
            ends = (ran.min(), ran.max()) if len(ran) else (math.nan, math.nan)
            yield *ends, in_words(values[alone], shown, _digits(unit))


def _digits(unit: str) -> int:
    """Return the digits of a margin in its unit."""
    return 0 if unit == "ms" else 2


def total_indices(margins: Floats, parameters: int) -> Floats:
    """Return total Sobol indices [parameters, 3] of a radial design: estimate, 2.5 and 97.5 % ends.

    margins [rows]: for each centre its value and those with one parameter after another changed.
    Jansen: S_T = E[(f(a) - f(a_i))^2] / (2 Var f). The interval is bootstrapped over the centres.
    """
    blocks = margins.reshape(-1, parameters + 1)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    rng = np.random.default_rng(0)
    picks = rng.integers(len(blocks), size=(1000, len(blocks)))
    drawn = np.concatenate([blocks[None], blocks[picks]])
    change = ((drawn[..., 1:] - drawn[..., :1]) ** 2).mean(axis=1)
    variance = drawn.reshape(len(drawn), -1).var(axis=1)
    indices = change / (2.0 * np.maximum(variance, 1e-30))[:, None]
    ends = np.quantile(indices[1:], [0.025, 0.975], axis=0)
    return np.stack([indices[0], *ends], axis=1)


def holds(values: Floats, margins: Floats) -> str:
    """Return between which values [n] margins [n] are positive: "always", "never" or ranges."""
    order = np.argsort(values)
    x, good = values[order], margins[order] > 0.0
    if good.all() or not good.any():
        return "always" if good.all() else "never"
    parts = []
    for begin, end in true_runs(good):
        parts.append(f"{x[begin]:g}" if end == begin + 1 else f"{x[begin]:g} to {x[end - 1]:g}")
    return ", ".join(parts)


def in_words(values: Floats, margins: Floats, digits: int) -> str:
    """Return the range of margins over swept values [n], bold with `holds` if it turns; NaN did not run.

    A range that is below half of the last digit is no effect.
    """
    ran = np.isfinite(margins)
    if not ran.any():
        return "not run"
    values, margins = values[ran], margins[ran]
    low, high = margins.min(), margins.max()
    if low > 0.0 and high - low < 0.5 * 10.0**-digits:
        return "none"
    text = f"{low:.{digits}f} to {high:.{digits}f}"
    where = holds(values, margins)
    return text if where == "always" else f"**{text}; holds: {where}**"
