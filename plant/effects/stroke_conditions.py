"""What is known of a stroke before it runs."""

from __future__ import annotations

from dataclasses import dataclass

from plant.kernel.layout import FIXED, LENGTH
from plant.kernel.packing import Load

KINDS = ("fixed", "N-B", "B-N", "N-F", "F-N")
FULL_DUTY = 0.98


@dataclass(frozen=True)
class StrokeConditions:
    """What is known of a stroke before it runs.

    kind: one of KINDS; pressures absolute [Pa]; load "none", "damper" or "spring"; spring rate
    [N/m] and start offset [m] (fixed rig; the spring is unloaded there); commands are
    (time s, valve, duty); charged_before names the chambers at supply pressure at time 0;
    mesh_force_n is the force barrier into gear, or out of gear for a shift to neutral;
    theoretical_flow replaces the mapped flows by 3.13/3.20; progress is where in its campaign the
    stroke is, 0 first, 1 last.
    """

    kind: str
    supply_pressure_pa: float
    commands: tuple[tuple[float, str, float], ...]
    atmosphere_pa: float = 101325.0
    temperature_k: float = 293.15
    load: str = "none"
    spring_n_per_m: float = 0.0
    start_offset_m: float = 0.0
    charged_before: tuple[str, ...] = ()
    damper_model: str = "compressible"
    mounted: bool = False
    mesh_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0
    rest_s: float = 60.0
    theoretical_flow: bool = False
    progress: float = 1.0

    @property
    def system(self) -> int:
        """Layout number of the actuator: FIXED or LENGTH."""
        return FIXED if self.kind == "fixed" else LENGTH

    @property
    def chambers(self) -> tuple[str, ...]:
        """Names of its chambers in order."""
        return ("1", "2") if self.kind == "fixed" else ("B", "N", "F")

    @property
    def start(self) -> str | float:
        """Where the stay is at time 0: position [m] of the fixed piston, gear of the length stroke."""
        return self.start_offset_m if self.kind == "fixed" else self.kind[0]

    @property
    def into_gear(self) -> bool:
        """True if the stroke engages a gear."""
        return self.kind in ("N-B", "N-F")

    def loads(self) -> Load:
        """Return the loads on the stay, as the equations take them."""
        return Load(
            damper=self.damper_model if self.load == "damper" else "none",
            spring_n_per_m=self.spring_n_per_m if self.load == "spring" else 0.0,
            spring_x0_m=self.start_offset_m,
            mounted=self.mounted,
            mesh_force_n=self.mesh_force_n if self.into_gear else 0.0,
            pull_force_n=0.0 if self.into_gear else self.mesh_force_n,
            sync_impulse_n_s=self.sync_impulse_n_s if self.into_gear else 0.0,
        )
