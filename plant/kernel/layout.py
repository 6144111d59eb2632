"""The records that the compiled equations read and write; symbols follow the thesis.

s stay, p piston, 1 and 2 the two pistons (or chambers of the fixed piston), B, N and F the chambers of the length
stroke.
"""

from __future__ import annotations

from enum import IntEnum

from plant.kernel.compiled import inlined
from plant.kernel.records import Record, Value, block, given
from plant.kernel.views import named

# The two actuators.
FIXED, LENGTH = 0, 1


class FixedState(Record):
    """State of the fixed piston."""

    x: Value  # position [m]
    v: Value  # velocity [m/s]
    p_1: Value  # chamber pressures [Pa]
    p_2: Value
    p_oil: Value  # pressure of the damper's chamber two [Pa]
    p_line: Value  # pressure of the supply line [Pa]
    m_1: Value  # mass of air in the chambers of a cylinder (`Modes.masses`) [kg]
    m_2: Value


class LengthState(Record):
    """State of the length stroke; the stay positive towards B, the pistons positive inward."""

    x_s: Value  # positions [m] and velocities [m/s] of stay and pistons
    v_s: Value
    x_1: Value
    v_1: Value
    x_2: Value
    v_2: Value
    p_b: Value  # chamber pressures [Pa]
    p_n: Value
    p_f: Value
    impulse: Value  # given to the synchronizer since it was armed [N s]
    p_oil: Value  # pressure of the damper's chamber two [Pa]
    p_line: Value  # pressure of the supply line [Pa]


class PistonState(Record):
    """One piston within the state of the length stroke."""

    x: Value
    v: Value


MAX_STATES = LengthState.size
FIRST_PRESSURE = (FixedState.p_1, LengthState.p_b)
FIRST_FIXED, FIRST_LENGTH = FIRST_PRESSURE
CHAMBERS = (2, 3)


@inlined
def pressures(fixed, y):
    """Return the view of the chambers' pressures in a state."""
    return y[FIRST_FIXED:] if fixed else y[FIRST_LENGTH:]


def pressure_slice(system: int) -> slice:
    """Return the columns of the chambers' pressures among a system's states."""
    first = FIRST_PRESSURE[system]
    return slice(first, first + CHAMBERS[system])


class Quadratures(Record):
    """Integrals behind the states; three chambers each, then energies [J]."""

    gas: Value = block(3)  # alpha_m R epsilon [J]
    heat: Value = block(3)  # (1 - alpha) P dV [J]
    work: Value = block(3)  # P dV [J]
    mass_in: Value = block(3)  # through the valve [kg]
    mass_out: Value = block(3)
    friction: Value
    damper: Value
    external: Value
    atmosphere: Value


class Modes(Record):
    """Modes of motion (int64); of a body 0 at rest, +1 / -1 moving in the direction of x_s (fixed piston: of x)."""

    stay: Value
    piston_1: Value
    piston_2: Value
    joined_1: Value  # contact of piston and stay: FREE, NUT or COLLAR
    joined_2: Value
    blocked: Value  # +1 / -1: held by the synchronizer at +x_block / -x_block
    damper: Value  # 0 none, 1 incompressible, 2 compressible
    system: Value  # FIXED or LENGTH
    oil_rest: Value  # compressible damper: 1 while its pressure is that of the atmosphere
    line: Value  # 1: the supply line has a volume and a restriction
    masses: Value  # 1: a cylinder, whose chambers keep a balance of mass and one of energy
    inside: Value  # 1 while the stay is between the synchronizer's two blocking positions
    side: Value  # +1 / -1: side of neutral on which the length stroke's damper acts
    # sides of the corners of the damper's law: 1 before them (`plant.parts.damper.damper_borders`)
    capped: Value
    opened: Value
    lifted: Value


FREE, NUT, COLLAR = 0, 1, 2
INCOMPRESSIBLE, COMPRESSIBLE = 1, 2


TERM_NODES = 24
MOST_ADDED = 3
ADDED_VALUES = MOST_ADDED * TERM_NODES
"""How many terms effects may add to the equations of one stroke, and values of all together."""


class Parameters(Record):
    """Parameters of one stroke, as far as `given` at the path of either actuator in a parameter set."""

    # gas
    r_air: Value = given("gas.R_air")
    t_gas: Value = given("gas.T")
    p_atm: Value
    p_supply: Value
    alpha_m1: Value = given("alpha.alpha_m1")  # process exponents: charge flow, volume at u = 1,
    alpha_1: Value = given("alpha.alpha_1")
    alpha_m2: Value = given("alpha.alpha_m2")  # discharge flow, volume at u = 0
    alpha_2: Value = given("alpha.alpha_2")
    k_in: Value  # factor on all charge flows
    k_out: Value  # factor on all discharge flows
    flow_model: Value  # 0 mapped, 1 orifice (3.13, 3.20), 2 ISO 6358
    cda_in: Value
    cda_out: Value
    closed_centre: Value  # 1: proportional valves, closed at u = 0.5
    gamma: Value = given("gas.gamma")
    valve_b: Value  # critical pressure ratio of a cylinder's valves
    air_kappa: Value  # exponent of a cylinder's chambers; 0: those of the thesis
    wall_heat: Value  # heat transfer coefficient of a cylinder's walls [W/(m^2 K)]
    wall_density: Value  # exponent of the air's density in it
    wall_ends: Value  # area of a chamber's ends that takes part, over that of two flat ones
    # geometry
    stroke: Value = given("fixed.stroke", "length.stroke")
    x_free: Value = given("", "length.x_free_total")
    area_p: Value = given("fixed.A1", "length.A_p")  # length stroke: annulus
    area_p2: Value = given("fixed.A2", "")
    area_s: Value = given("fixed.A_s", "length.A_s")
    vol_b: Value = given("fixed.V10", "length.V_B0")
    vol_n: Value = given("fixed.V20", "length.V_N0")
    vol_f: Value = given("", "length.V_F0")
    m_s: Value = given("fixed.m_s", "length.m_s")  # stay with everything that moves with it
    m_p: Value = given("", "length.m_p")
    bond: Value = given("", "length.F_bond")  # pull that a contact bears between the gears
    # friction of the stay (fixed piston: of the whole) and of a piston
    f_static_s: Value = given("friction_fixed.F_sf", "friction_length.F_sf_s")
    f_run_s: Value = given("friction_fixed.F_rf", "friction_length.F_rf_s")
    beta_s: Value = given("friction_fixed.beta", "friction_length.beta_s")
    f_static_p: Value = given("", "friction_length.F_sf_p")
    f_run_p: Value = given("", "friction_length.F_rf_p")
    beta_p: Value = given("", "friction_length.beta_p")
    f_linkage: Value  # added to the stay's static and sliding friction
    stribeck_v: Value  # 0: the friction falls at once
    asymmetry: Value  # friction times (1 + a) towards +, (1 - a) towards -
    bump_force: Value
    bump_x: Value
    bump_width: Value
    seal_mu: Value  # friction per force of the pressure difference across the piston
    damper_drag: Value  # extra friction of the stay with the damper mounted
    # loads on the stay
    mesh_force: Value
    pull_force: Value
    x_mesh: Value = given("synchronizer.x_mesh")
    w_mesh: Value = given("synchronizer.w_mesh")
    w_pull: Value = given("synchronizer.w_pull")
    x_block: Value = given("synchronizer.x_block")
    sync_impulse: Value
    spring_k: Value
    spring_x0: Value
    f_external: Value
    detent_force: Value
    detent_width: Value
    # stops
    restitution: Value = given("stops.restitution")
    stop_offset: Value  # the engaged stop has moved outward by this much
    # leaks, as orifice areas C_d A
    leak_piston: Value
    leak_atm: Value
    # supply line
    line_volume: Value
    line_cda: Value
    # slopes of the process exponents against the speed of the piston
    alpha_speed_m1: Value
    alpha_speed: Value
    alpha_speed_m2: Value
    alpha_speed_2: Value
    alpha_v0: Value  # speed beyond which the exponents change no further; 0: they go on
    # oil damper
    a_oil: Value = given("damper.A_oil")
    a_small: Value = given("damper.A_S")
    a_large: Value = given("damper.A_B0")
    r_hole: Value = given("damper.r_hole")
    x_hole: Value = given("damper.x_B")
    rho_oil: Value = given("damper.rho")
    kappa: Value = given("damper.kappa_effective")
    air_fraction: Value
    v_oil: Value = given("damper.V_oil2_0")
    cd_floor: Value = given("damper.C_D_floor")
    cd_slope: Value = given("damper.C_D_slope")
    # terms that effects add: address of `plant.parts.term.sum_of_terms` (0: none), how many terms and
    # values there are, and of each term its slot, its function's address and its first value's index
    adder: Value
    added_count: Value
    added_used: Value
    added: Value = block(MOST_ADDED, 3)
    added_values: Value = block(ADDED_VALUES)


class Slot(IntEnum):
    """Where a term enters; of a non-parametric one, as `equation` of an extended model writes it.

    NONE to EXPONENT: slots of the equations (`Parameters.added`), FLOW_1 to FLOW_3 into a chamber; the others but
    POSITION and GAUGE have one level a stroke.
    """

    NONE = 0
    FORCE = 1  # on the stay [N]
    FLOW_1 = 2  # T m_dot into chamber 1 or B, 2 or N, F [K kg/s]
    FLOW_2 = 3
    FLOW_3 = 4
    RESISTANCE = 5  # of the stay [N]
    CHARGE = 6  # share of the charge flow, of P / P_s
    DISCHARGE = 7  # share of the discharge flow, of P / P_atm
    LEAK = 8  # T m_dot out of every chamber, of its pressure [K kg/s]
    EXPONENT = 9  # shift of the exponents of the volume terms, of speed
    RISE = 10
    FALL = 11
    SUPPLY = 12
    POSITION = 13
    GAUGE = 14
    FRICTION = 15
    CHARGE_LEVEL = 16
    DISCHARGE_LEVEL = 17


class Over(IntEnum):
    """Variable that a term depends on, as `variable` of an extended model writes it.

    SPEED: or pressure, as the equation has it. One value a stroke have REST (log10 of the rest before it [s]),
    PROGRESS (in its campaign, 0 first, 1 last) and VALVE (the one that drives it: 1, B, N, F are 0 to 3).
    """

    TIME = 0
    POSITION = 1
    SPEED = 2
    REST = 3
    PROGRESS = 4
    VALVE = 5


class FlowMap(Record):
    """Coefficients of the two flow maps: polynomials in y = P / P_s and z = P / P_atm."""

    y_min: Value
    y_split: Value
    charge_high: Value = block(4)  # y below y_split
    charge_low: Value = block(5)
    charge_slope: Value  # phi'(1)
    z_split: Value
    discharge_low: Value = block(5)  # z below z_split
    discharge_high: Value = block(3)
    discharge_slope: Value  # phi'(1)


class Guard(IntEnum):
    """Guards of the modes, each positive until its event; from CAPPED on corners of a law, no events."""

    TURN = 0
    PISTON_1_TURN = 1
    PISTON_2_TURN = 2
    STOP_HIGH = 3  # the stay meets its upper or lower stop
    STOP_LOW = 4
    PISTON_1_STOP = 5  # the outer stop
    PISTON_2_STOP = 6
    NUT_1_CONTACT = 7  # a free piston meets the stay
    COLLAR_1_CONTACT = 8
    NUT_2_CONTACT = 9
    COLLAR_2_CONTACT = 10
    PISTON_1_SEPARATION = 11  # a joined piston parts from the stay
    PISTON_2_SEPARATION = 12
    BREAKAWAY = 13
    PISTON_1_BREAKAWAY = 14
    PISTON_2_BREAKAWAY = 15
    UNBLOCK = 16  # the synchronizer lets the stay pass
    OIL_EMPTY = 17  # the damper's oil comes to the pressure of the atmosphere, or leaves it
    OIL_FILL = 18
    DAMPER_SIDE = 19  # the stay comes to the damper's other side
    CAPPED = 20  # see `plant.parts.damper.damper_borders`
    OPENED = 21
    LIFTED = 22

    @property
    def event(self) -> str:
        """Name of the event."""
        return self.name.removesuffix("_HIGH").removesuffix("_LOW").replace("_", " ").lower()


GUARDS = len(Guard)


class Impact(Record):
    """What the resets at one instant did."""

    lost: Value  # kinetic energy turned to heat [J]
    speed: Value  # of the stay into a stop [m/s]
    at_block: Value  # 1 if the stop was the synchronizer


class EventRow(Record):
    """One event as the kernels store it."""

    time: Value
    guard: Value
    lost: Value
    speed: Value
    at_block: Value
    x: Value
    v: Value


class GridRow(Record):
    """One step of a grid: written by one stroke and followed by others."""

    end: Value  # time at which the step was to end [s]
    switch: Value  # 1 if that was the next switch
    guard: Value  # that ended it before, -1 if none did


# `p = parameters(p)` makes an array, or a view without names, one with the names of the record.
parameters = named(Parameters)
modes = named(Modes)
flow_map = named(FlowMap)
fixed_state = named(FixedState)
length_state = named(LengthState)
piston_state = named(PistonState)
quadratures_of = named(Quadratures)
impact_of = named(Impact)
event_row = named(EventRow)
grid_row = named(GridRow)
