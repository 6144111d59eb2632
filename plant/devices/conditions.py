"""What a run states of the actuator itself."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from plant.devices.valve import Drive

ChamberName = Literal["B", "N", "F"]
Newtons = Annotated[float, Meta(ge=0.0, le=1e5)]


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Conditions of the actuator: where it is mounted, what it is fed with, what resists it."""

    mounted: bool = False
    """Mounted on the gearbox, with its masses, teeth and synchronizer; otherwise in the lab."""
    supply_pressure_pa: Annotated[float, Meta(ge=1e5, le=2e6)] | None = None
    """Supply pressure, absolute; if left out, the model's supply.P_s."""
    charged: tuple[ChamberName, ...] = ()
    """Chambers at supply pressure at the start; the others are at atmospheric pressure."""
    damper: Literal["none", "incompressible", "compressible"] = "none"
    """Oil damper on the stay, and how its oil is modelled."""
    mesh_force_n: Newtons = 0.0
    """Peak of the force against meshing, on the way into a gear."""
    pull_force_n: Newtons = 0.0
    """Peak of the force that holds the teeth, on the way out of a gear."""
    drive: Drive = "delays"
    """Valves as time delays, or with the current of their coils (see [coil])."""
    closing_follows_duty: bool = False
    """A valve closes sooner the less current is in its coil, after a short or a reduced duty; with drive = "delays"."""
    speeds_period_s: Annotated[float, Meta(ge=0.001, le=0.02)] = 0.01
    """Period of the DrivelineSpeeds frames."""
    truth_period_s: Annotated[float, Meta(ge=0.001, le=1.0)] = 0.01
    """Period of the frames that carry the true motion and pressures."""
