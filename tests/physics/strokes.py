"""The strokes that the physics tests run: every kind with every load that it can carry."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from plant.kernel.packing import Load
from plant.parameters import ParameterSet
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import StrokeConditions
from tests.reference.actuator import Case


def conditions_of(case: Case) -> StrokeConditions:
    """A case of the judge as the plant's conditions."""
    load = "damper" if case.damper else ("spring" if case.spring_n_per_m else "none")
    return StrokeConditions(
        case.kind,
        case.supply_pa,
        case.commands,
        charged_before=case.charged,
        load=load,
        damper_model=case.damper or "compressible",
        spring_n_per_m=case.spring_n_per_m,
        start_offset_m=case.start_m,
        mounted=case.mounted,
        mesh_force_n=case.mesh_force_n,
        sync_impulse_n_s=case.sync_impulse_n_s,
    )


def length_stroke(parameters: ParameterSet, **given: Any) -> LengthStroke:
    """The length stroke under what is given, loads and other conditions together."""
    load = {item.name: given.pop(item.name) for item in fields(Load) if item.name in given}
    return LengthStroke(parameters, load=Load(**load), **given)


def every_stroke() -> dict[str, Case]:
    """Name -> case."""
    cases: dict[str, Case] = {}
    for kind in ("fixed", "N-B", "B-N", "N-F", "F-N"):
        valve = "1" if kind == "fixed" else kind[-1]
        commands = ((0.01, valve, 0.98), (0.2, valve, 0.0))
        cases[f"{kind}"] = Case(kind, commands=commands)
        cases[f"{kind} 6 bar"] = Case(kind, 6e5, commands)
        if kind in ("fixed", "N-B", "N-F"):
            for model in ("incompressible", "compressible"):
                cases[f"{kind} {model}"] = Case(kind, commands=commands, damper=model)
        if kind == "fixed":
            cases["fixed spring"] = Case(
                kind, commands=commands, spring_n_per_m=25000.0, start_m=0.00425827892
            )
            continue
        cases[f"{kind} truck"] = Case(kind, commands=commands, mounted=True, mesh_force_n=600.0)
        if kind.startswith("N"):
            cases[f"{kind} truck sync"] = Case(
                kind, commands=commands, mounted=True, mesh_force_n=800.0, sync_impulse_n_s=14.0
            )
        old = kind[0]
        cases[f"{kind} charged"] = Case(
            kind,
            commands=((0.01, valve, 0.98), (0.01, old, 0.0), (0.2, valve, 0.0)),
            charged=(old,),
        )
    return cases


ALL = every_stroke()
