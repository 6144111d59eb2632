"""In what healthy trucks differ, and the shifts of one truck: quantities with their priors.

Those of the actuator have the parameter set's tolerances, or what a calibration leaves of them; gearbox, teeth, cone, supply and the way of a
pulse to the log are unknown within wider limits. How much the loads of the gearbox differ from shift to
shift is a parameter itself.
Checked by: tests/unit/sil/inference/truck/test_simulator.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plant.parameters import ParameterSet
from sil.inference.problem import Floats


@dataclass(frozen=True)
class Quantity:
    """A quantity of the truck, as a deviation from the usual one; factors in logarithms.

    unit_sd, shift_sd: standard deviations between trucks, and between shifts of one (0: none), in its
    unit; is_load: the latter is only where its own estimation begins; acts: on which shifts; usual: the usual
    one, of a force.
    """

    name: str
    label: str
    unit: str
    unit_sd: float
    shift_sd: float = 0.0
    is_load: bool = False
    acts: str = "always"
    usual: float = 0.0


def quantities(
    parameters: ParameterSet, supply_is_known: bool, trips: int = 1
) -> tuple[Quantity, ...]:
    """Return the quantities of a truck with the actuator of a parameter set, and of so many trips."""
    value = parameters.value
    delay = value("repeatability.unit_valve_delay_sd")
    flow, volume = (value(f"repeatability.unit_{name}_sd") for name in ("flow", "volume"))
    friction, jitter = (value(f"repeatability.{n}_sd") for n in ("friction", "valve_delay"))
    supply, trip_supply = (0.02, 0.02) if supply_is_known else (0.08, 0.1)
    unit_friction = value("repeatability.unit_friction_sd")
    usual = (
        Quantity("friction", "friction of stay and pistons", "-", unit_friction, friction),
        Quantity("rise", "opening delay", "s", delay, jitter),
        Quantity("fall", "closing delay", "s", 3.0 * delay, jitter),
        Quantity("flow_in", "charge flow", "-", flow),
        Quantity("flow_out", "discharge flow", "-", flow),
        Quantity("volume_a", "volume of chambers B, F", "-", volume),
        Quantity("volume_b", "volume of chamber N", "-", volume),
        Quantity("supply", "supply pressure", "-", supply, 0.02, True),
        Quantity("linkage", "friction of the linkage", "-", 0.3, acts="mounted"),
        Quantity("mass", "mass of the gearbox", "-", 0.2, acts="mounted"),
        Quantity("mesh", "barrier into gear", "N", 500.0, 300.0, True, "into gear", 600.0),
        # a stay that rebounds meets it on the way into gear, too
        Quantity("pull", "barrier out of gear", "N", 400.0, 300.0, True, "mounted", 300.0),
        Quantity("cone", "impulse per speed difference", "-", 1.0, 0.5, True, "into gear"),
        Quantity("latency", "way of a pulse to the log", "s", 3e-4, 1e-4),
        Quantity("offset", "offset of the position", "m", 1e-4, acts="report"),
        Quantity("gain", "gain of the position", "-", 0.005, acts="report"),
        *(
            Quantity(
                f"supply_{k}", f"supply pressure, log {k + 1}", "-", trip_supply, acts=f"trip {k}"
            )
            for k in range(trips if trips > 1 else 0)
        ),
    )
    calibrated = {
        item.name: value(f"posterior_truck.{item.name}")
        for item in usual
        if f"posterior_truck.{item.name}" in parameters
    }
    return tuple(replace(item, unit_sd=calibrated.get(item.name, item.unit_sd)) for item in usual)


class Layout:
    """Quantities as columns of arrays.

    at: column by name; unit_sd [quantities], shift_sd [differing]; differing: columns of the quantities
    that differ between shifts; of_trips: columns of the supplies of trips; simulated [quantities]: whose derivatives
    have to be; is_load: which of these have an estimated standard deviation;
    of_gears: which of these are loads of getting into a gear, or out of it.
    """

    def __init__(self, own: tuple[Quantity, ...]) -> None:
        self.own = own
        self.at = {item.name: k for k, item in enumerate(own)}
        self.unit_sd: Floats = np.array([item.unit_sd for item in own])
        self.differing = np.array([k for k, item in enumerate(own) if item.shift_sd > 0.0])
        self.shift_sd: Floats = np.array([own[k].shift_sd for k in self.differing])
        self.of_trips = np.array(
            [k for k, item in enumerate(own) if item.acts.startswith("trip")], dtype=np.int64
        )
        elsewhere = ("report", "trip")  # of what was simulated, or as of another quantity
        self.simulated = np.array([not item.acts.startswith(elsewhere) for item in own])
        self.is_load = np.array([own[k].is_load for k in self.differing])
        self.of_gears = np.flatnonzero(self.is_load & (self.differing != self.at["supply"]))

    def __len__(self) -> int:
        return len(self.own)

    def amounts(self, unit: Floats, each: Floats) -> Floats:
        """Return deviations [..., shifts, quantities] in their units, of those [..., quantities] and [..., shifts, differing] in standard deviations."""
        out = np.repeat((unit * self.unit_sd)[..., None, :], each.shape[-2], axis=-2)
        out[..., self.differing] += each * self.shift_sd
        return out

    def in_proportion(self, unit: Floats, factor: float) -> Floats:
        """Return a truck's quantities [quantities], in standard deviations, with supply, loads and mass times a factor.

        It moves nearly as before.
        """
        out = unit.copy()
        for name in ("supply", "mass", "linkage", "cone"):
            out[self.at[name]] += np.log(factor) / self.unit_sd[self.at[name]]
        for name in ("mesh", "pull"):
            column = self.at[name]
            out[column] += (factor - 1.0) * (
                self.own[column].usual / self.unit_sd[column] + unit[column]
            )
        return out
