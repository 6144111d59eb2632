"""The actuator as a co-simulation unit: coil duties in, true states out.

Runs inside the importing tool's Python, where this package must be installed; settings.json next to
this file is the scenario it was exported from. The duties hold from the beginning of each step.
"""

from __future__ import annotations

from typing import Any

from pythonfmu3 import DefaultExperiment, Float64, Fmi3Slave, Unit

DUTIES = ("duty_b", "duty_n", "duty_f")
STATES = {
    "position_m": "m",
    "velocity_m_s": "m/s",
    "piston_1_m": "m",
    "piston_2_m": "m",
    "pressure_b_pa": "Pa",
    "pressure_n_pa": "Pa",
    "pressure_f_pa": "Pa",
}
VALVES = ("valve_b", "valve_n", "valve_f")


class Opc4Plant(Fmi3Slave):
    """Length stroke with its three valves; positions from neutral, backward positive."""

    author = "opc4-sil"
    description = (
        "Pneumatic gear-shift actuator: three chambers, sliding pistons, valves with delays."
    )

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        from plant.devices.coil import make_valve
        from plant.devices.valve import ValveTiming
        from plant.kernel.packing import Load
        from plant.systems.length_stroke import LengthStroke
        from sil.fmu.slave import declare, prepare
        from sil.simulation.build import INITIAL

        self.loaded = prepare(self)
        self.default_experiment = DefaultExperiment(0.0, self.loaded.scenario.duration_s, 0.001)
        table, parameters = self.loaded.scenario.plant, self.loaded.parameters
        driveline = self.loaded.scenario.driveline
        impulses = (driveline.impulse_backward_n_s, driveline.impulse_forward_n_s)
        charged = tuple(table.charged)
        self.stroke = LengthStroke(
            parameters,
            initial=INITIAL[self.loaded.scenario.initial_gear],
            supply_pressure_pa=table.supply_pressure_pa,
            charged=charged,
            load=Load(
                damper=table.damper,
                mounted=table.mounted,
                mesh_force_n=table.mesh_force_n,
                pull_force_n=table.pull_force_n,
                sync_impulse_n_s=max(i or 0.0 for i in impulses),
            ),
        )
        timing = ValveTiming.from_parameters(parameters, table.closing_follows_duty)
        duty = parameters.value("valve.duty_nominal")
        self.valves = [
            make_valve(
                table.drive, timing, self.loaded.scenario.coil, c in charged, duty * (c in charged)
            )
            for c in "BNF"
        ]
        self.register_units([Unit("m", m=1), Unit("m/s", m=1, s=-1), Unit("Pa", kg=1, m=-1, s=-2)])
        about_duty = dict.fromkeys(DUTIES, "duty of the coil, 0 to 1")
        about_valve = dict.fromkeys(VALVES, "1 open to supply, 0 open to atmosphere")
        declare(self, Float64, dict.fromkeys(DUTIES, 0.0), output=False, descriptions=about_duty)
        declare(
            self, Float64, dict.fromkeys(STATES, 0.0), output=True, continuous=True, units=STATES
        )
        declare(self, Float64, dict.fromkeys(VALVES, 0.0), output=True, descriptions=about_valve)
        self._read()

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance the actuator over one communication step."""
        begin_ns, end_ns = round(current_time * 1e9), round((current_time + step_size) * 1e9)
        if begin_ns == 0:
            self.stroke.advance(0)
        switches = []
        for chamber, (valve, name) in enumerate(zip(self.valves, DUTIES, strict=True)):
            valve.command(begin_ns, min(max(getattr(self, name), 0.0), 1.0))
            switches += [(t, chamber, u) for t, u in valve.moves(end_ns)]
        self.stroke.advance(end_ns, sorted(switches))
        self.time = current_time + step_size
        self._read()
        return True

    def _read(self) -> None:
        stroke = self.stroke
        values = (stroke.position_m, stroke.velocity_m_s, *stroke.pistons_m, *stroke.pressures_pa)
        for name, value in zip(STATES, values, strict=True):
            setattr(self, name, float(value))
        for name, valve in zip(VALVES, self.valves, strict=True):
            setattr(self, name, float(valve.is_open))
