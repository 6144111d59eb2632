"""A user's own effects: a Python file outside the package, of the form of the files in plant/effects.

What is wrong with it is found when it is loaded: statements, compilation of its terms, their values all over the
ranges, and any change while its parameters are neutral.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import math
import sys
import traceback
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import numpy as np

from can_dbc.errors import nearest
from can_dbc.user_file import ProcessExit, before_running, exits_raise, read_user_text, resolved
from plant import effects as catalogue
from plant.effects.added_term import ALL_TERMS, shown
from plant.effects.effect import Effect, EffectParameter, Need, Scope, Variant
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import KINDS, StrokeConditions
from plant.errors import InputError
from plant.kernel.layout import Parameters
from plant.parameters import load

MARK = "@sha256:"
"""Separates a file's path from the hash of its content, where a run stores it."""

_LOADED: dict[str, tuple[str, tuple[str, ...]]] = {}
"""Path of each loaded file -> hash of its content, and the effects in it."""


def load_effects(where: str) -> str:
    """Add the effects of a file to the catalogue; return PATH@sha256:HASH, which loads exactly it.

    where: a path, or what an earlier call returned. Raises InputError naming file, line, what is wrong and what was
    expected: no such file, not Python, an effect incomplete, inconsistent or with an id that exists, a term that numba
    cannot compile or that is not finite, another content than that of the hash.
    """
    name, _, expected = where.partition(MARK)
    path = resolved(name)
    text = read_user_text(name, "a Python file of effects")
    digest = hashlib.sha256(text.encode()).hexdigest()
    if expected and digest != expected:
        raise InputError(
            f"{name}: has changed: sha256 {digest[:12]}; expected {expected[:12]}, as it ran before"
        )
    file = str(path)
    before = _LOADED.get(file)
    if before is None or before[0] != digest:
        for identifier in before[1] if before else ():
            del catalogue.CATALOGUE[identifier]
        _LOADED.pop(file, None)
        effects = effects_of(name, file, text)
        for item in effects:
            catalogue.CATALOGUE[item.id] = item
        _LOADED[file] = digest, tuple(item.id for item in effects)
    return f"{file}{MARK}{digest}"


def loaded_effects() -> dict[str, str]:
    """Return the effects of users' files -> PATH@sha256:HASH of the file."""
    return {
        identifier: f"{file}{MARK}{digest}"
        for file, (digest, identifiers) in _LOADED.items()
        for identifier in identifiers
    }


def effects_of(name: str, file: str, text: str) -> tuple[Effect, ...]:
    """Return the checked effects of a file's text, `name` being its path in messages. Raises InputError for what is wrong."""
    module = ModuleType(f"opc4_effects_{Path(file).stem}")
    module.__file__ = file
    sys.modules[module.__name__] = module  # dataclasses of the file look their module up
    first = len(ALL_TERMS)
    for prepare in before_running:
        prepare(name)
    try:
        with exits_raise():
            exec(compile(text, file, "exec"), module.__dict__)
        shipped = set(map(id, catalogue.CATALOGUE.values()))
        stated = {id(item): item for item in vars(module).values() if isinstance(item, Effect)}
        effects = tuple(guarded(item, file) for key, item in stated.items() if key not in shipped)
        if not effects:
            raise InputError(f"{file}: no effect; expected functions under @effect(...)")
        identifiers = set(catalogue.CATALOGUE)
        for item in effects:
            check_effect(item, file, identifiers)
            identifiers.add(item.id)
    except BaseException as error:
        del ALL_TERMS[first:]
        if isinstance(error, KeyboardInterrupt | MemoryError):
            raise
        raise InputError(described(error, file).replace(file, name)) from None
    return effects


def guarded(item: Effect, file: str) -> Effect:
    """Return an effect whose errors, at any values, are one line."""

    @functools.wraps(item.change)
    def change(setup: Setup, values: dict[str, float]) -> None:
        try:
            with exits_raise():
                item.change(setup, values)
        except (Exception, SystemExit, ProcessExit) as error:
            expected = f"no error at {shown(values)}"
            raise InputError(described(error, file, expected)) from None
        if not np.isfinite(setup.p.array).all():
            raise InputError(
                f"{where_of(item, file)}: at {shown(values)} it sets a parameter that is not finite"
            )

    return replace(item, change=change)


def where_of(item: Effect, file: str) -> str:
    """Return FILE:LINE: and the effect, of the file in which its function is."""
    code = getattr(inspect.unwrap(item.change), "__code__", None)
    begin = f"{code.co_filename}:{code.co_firstlineno}" if code else f"{file}:1"
    return f"{begin}: effect {item.id!r}"


def described(error: BaseException, file: str, expected: str = "a Python file of effects") -> str:
    """Return an error of a user's file as FILE:LINE: what is wrong; expected ..."""
    if isinstance(error, SyntaxError):
        return f"{file}:{error.lineno}: not valid Python: {error.msg}; expected {expected}"
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    said = " ".join(str(error).split())
    line = f":{frames[-1].lineno}" if frames else ""
    if isinstance(error, InputError):
        return said if said.startswith(file) else f"{file}{line}: {said}"
    said = said.replace("EffectParameter.__init__()", "EffectParameter()")
    return f"{file}{line}: {type(error).__name__}: {said}; expected {expected}"


def check_effect(item: Effect, file: str, identifiers: set[str]) -> None:
    """Check statements, terms and neutrality of one effect. Raises InputError with file and line."""
    where = where_of(item, file)
    for wrong in statement_errors(item, identifiers):
        raise InputError(f"{where}: {wrong}")
    for setup in probe_setups(item):
        check_neutral(item, setup, where)
        for values in tried_values(item):
            list(evaluated(changed(item, setup, values)))


def statement_errors(item: Effect, identifiers: set[str]) -> Iterator[str]:
    """Yield what is wrong with the statements of an effect."""
    if not (isinstance(item.id, str) and item.id.isidentifier() and item.id.islower()):
        yield "expected an id in lower case, of letters, digits and _"
    if item.id in identifiers:
        yield "exists already; expected another id"
    for name in ("cause_class", "equation", "what"):
        text = getattr(item, name)
        if not isinstance(text, str) or not text.strip():
            yield f"{name} {text!r}; expected a text"
    if not item.parameters or not all(isinstance(p, EffectParameter) for p in item.parameters):
        yield f"parameters {item.parameters!r}; expected one EffectParameter(...) or more"
        return
    for p in item.parameters:
        yield from parameter_errors(p)
    fitted = [p for p in item.parameters if p.fitted]
    if not fitted:
        yield "no parameter is fitted; expected one or more that are no choice(...)"
    names = [p.name for p in item.parameters]
    if len(set(names)) != len(names):
        yield f"parameters {', '.join(names)}; expected different names"
    yield from variant_errors(item, len(fitted))
    yield from need_errors(item.needs)
    if not callable(item.scope) and item.scope not in get_args(Scope):
        yield f"scope {item.scope!r}; expected {', '.join(get_args(Scope))}"
    if isinstance(item.look_alikes, str):
        yield f"look_alikes: {item.look_alikes!r}; expected a tuple of ids, as ({item.look_alikes!r},)"
        return
    for other in item.look_alikes:
        if other not in identifiers:
            near = ", ".join(nearest(other, identifiers, cutoff=0.3) or sorted(identifiers)[:3])
            yield f"look_alikes: {other!r} is no effect; expected one of {near}, ..."


def variant_errors(item: Effect, fitted: int) -> Iterator[str]:
    """Yield what is wrong with the variants of an effect that has so many fitted parameters."""
    choices = {p.name for p in item.parameters if not p.fitted}
    for variant in item.variants:
        if not isinstance(variant, Variant) or not set(variant.fixed) <= choices:
            yield f"variant {variant!r}; expected fixed to name choices: {', '.join(choices) or 'none'}"
            continue
        if any(len(start) != fitted for start in variant.starts):
            yield f"variant {variant.name!r}: starts; expected {fitted} values each"
        prior = variant.prior
        if isinstance(prior, bool) or not isinstance(prior, int | float) or not 0.0 < prior <= 1.0:
            yield f"variant {variant.name!r}: prior {prior!r}; expected more than 0, at most 1"
        yield from need_errors(variant.needs)


def parameter_errors(p: EffectParameter) -> Iterator[str]:
    """Yield what is wrong with the statements of a parameter."""
    numbers = {name: getattr(p, name) for name in ("neutral", "low", "high", "typical", "sign")}
    for name, value in numbers.items():
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            yield f"{p.name}: {name} {value!r}; expected a finite number"
            return
    if not (isinstance(p.name, str) and p.name.isidentifier() and isinstance(p.unit, str)):
        yield f"{p.name!r}, {p.unit!r}: expected a name of letters, digits and _, and a unit"
    if not p.low <= p.neutral <= p.high:
        yield f"{p.name}: neutral {p.neutral:g}; expected it from low {p.low:g} to high {p.high:g}"
    if not p.typical > 0.0:
        yield f"{p.name}: typical {p.typical:g}; expected more than 0"
    if p.sign not in (-1, 0, 1):
        yield f"{p.name}: sign {p.sign}; expected -1, 0 or 1"


def need_errors(needs: Any) -> Iterator[str]:
    """Yield what is wrong with what an effect says it needs."""
    for need in needs:
        if need not in get_args(Need):
            yield f"needs: {need!r}; expected {', '.join(get_args(Need))}"


@functools.cache
def probes() -> tuple[Setup, ...]:
    """Return a setup of every kind of stroke, some with the oil damper."""
    commands = {"fixed": "1", "N-B": "B", "B-N": "N", "N-F": "F", "F-N": "N"}
    conditions = [
        StrokeConditions(kind, 9e5, ((0.01, commands[kind], 0.98),), load=rod_load)
        for kind in KINDS
        for rod_load in ("none", "damper")
    ]
    return tuple(Setup.of(load(), one) for one in conditions)


def probe_setups(item: Effect) -> list[Setup]:
    """Return the probes that an effect can act on."""
    return [
        setup
        for setup in probes()
        if ("damper" not in item.needs or setup.conditions.load == "damper")
        and ("length stroke" not in item.needs or setup.conditions.kind != "fixed")
    ]


def tried_values(item: Effect) -> Iterator[dict[str, float]]:
    """Yield values of all parameters: typical sizes, and each at its bounds."""
    for variant in item.variants:
        usual = {p.name: p.neutral for p in item.parameters} | dict(variant.fixed)
        for p in (p for p in item.parameters if p.fitted):
            step = p.sign * p.typical if p.sign else p.typical
            usual[p.name] = min(max(p.neutral + step, p.low), p.high)
        yield usual
        for p in (p for p in item.parameters if p.fitted):
            yield usual | {p.name: p.low}
            yield usual | {p.name: p.high}


def changed(item: Effect, setup: Setup, values: dict[str, float]) -> Setup:
    """Return a copy of a setup with an effect applied, also at its neutral parameters."""
    twin = setup.copy()
    item.change(twin, values)
    return twin


def check_neutral(item: Effect, setup: Setup, where: str) -> None:
    """Check that an effect changes nothing at its neutral parameters. Raises InputError."""
    values = {p.name: p.neutral for p in item.parameters}
    twin = changed(item, setup, values)
    for call, value in evaluated(twin):
        if value != 0.0:
            raise InputError(f"{call} = {value:g} at the neutral parameters; expected 0")
    # without a meaning while another one, the size of what they shape, is neutral
    shapes = ("bump_x", "bump_width", "detent_width", "alpha_v0", "line_volume")
    for name in Parameters.fields:
        if name.startswith("added") or name in ("adder", *shapes):
            continue
        old, new = getattr(setup.p, name), getattr(twin.p, name)
        if not np.array_equal(old, new):
            raise InputError(
                f"{where}: at its neutral parameters it changes {name} from {old} to {new}; "
                "expected no change"
            )


def evaluated(setup: Setup) -> Iterator[tuple[str, float]]:
    """Yield the calls of a setup's added terms all over their ranges, and results. Raises InputError if not finite."""
    rows = setup.p.added[: int(setup.p.added_count)].tolist()
    for term, (slot, address, first) in product(ALL_TERMS, rows):
        if term.slot != slot or term.compiled.address != address:
            continue
        passed = setup.p.added_values[int(first) : int(first) + len(term.values)].tolist()
        for at, value in term.tried(passed):
            call = term.called(at, passed)
            if not math.isfinite(value):
                raise InputError(f"{call} = {value}; expected a finite number")
            yield call, value
