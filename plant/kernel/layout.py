"""Where each number stands in the arrays that the compiled equations read and write.

A stroke's parameters are one flat float64 array `p`; its state another, `y`; its modes an int64
array `m`.  The constants here are the only place that knows the order.
"""

from __future__ import annotations

# --- systems ----------------------------------------------------------------------------------
FIXED = 0
LENGTH = 1

# --- state of the fixed piston ----------------------------------------------------------------
FX, FV, FP1, FP2, FOIL, FLINE = 0, 1, 2, 3, 4, 5
FIXED_STATES = 6

# --- state of the length stroke: pistons inward positive, stay positive towards backward --------
XS, VS, X1, V1, X2, V2, PB, PN, PF, SPENT, LOIL, LLINE = range(12)
LENGTH_STATES = 12

MAX_STATES = 12
# Quadratures behind the states, per chamber (3): gas in, compression heat, work, mass in, mass out;
# then friction, damper, external, atmosphere, synchroniser.
QUADRATURES = 20
Q_GAS, Q_HEAT, Q_WORK, Q_MASS_IN, Q_MASS_OUT = 0, 3, 6, 9, 12
Q_FRICTION, Q_DAMPER, Q_EXTERNAL, Q_ATMOSPHERE, Q_STOPS = 15, 16, 17, 18, 19

# --- modes --------------------------------------------------------------------------------------
# status of a body: 0 at rest, +1 / -1 moving, in the direction of x_s (fixed: of x)
M_STAY, M_PISTON1, M_PISTON2 = 0, 1, 2
# joined to the stay: 0 no, 1 at the nut, 2 at the collar
M_JOINED1, M_JOINED2 = 3, 4
M_BLOCKED = 5  # +1 / -1: held by the synchronizer at +x_block / -x_block
M_DAMPER = 6  # 0 none, 1 incompressible, 2 compressible
M_SYSTEM = 7
M_OIL_REST = 8  # compressible damper: 1 while its pressure stands at atmosphere
M_LINE = 9  # 1: supply line with volume and restriction (hose droop)
M_INSIDE = 10  # 1 while the stay is between the two blocking positions of the synchronizer
M_SIDE = 11  # +1 / -1: side of neutral on which the length stroke's damper acts
# sides of the corners of the damper's law: 1 before them (`plant.parts.damper.borders`)
M_CAPPED, M_OPEN, M_LIFTED = 12, 13, 14
MODES = 15
FREE, NUT, COLLAR = 0, 1, 2

# --- parameters -----------------------------------------------------------------------------------
(
    R_AIR,
    T_GAS,
    P_ATM,
    P_SUPPLY,
    ALPHA_M1,
    ALPHA_1,
    ALPHA_M2,
    ALPHA_2,
    K_IN,  # factor on all charge flows
    K_OUT,  # factor on all discharge flows
    FLOW_MODEL,  # 0 mapped, 1 orifice (3.13/3.20)
    CDA_IN,
    CDA_OUT,
    GAMMA,
    # geometry
    STROKE,
    X_FREE,
    AREA_P,  # length: annulus A_p; fixed: A1
    AREA_P2,  # fixed: A2
    AREA_S,
    VOL_B,  # length V_B0, fixed V10
    VOL_N,  # length V_N0, fixed V20
    VOL_F,
    M_S,  # stay, with everything that moves with it
    M_P,
    # friction of the stay (fixed piston: of the whole)
    F_STATIC_S,
    F_RUN_S,
    BETA_S,
    F_STATIC_P,
    F_RUN_P,
    BETA_P,
    F_LINKAGE,  # added to the stay's static and sliding friction
    STRIBECK_V,  # 0: the level falls at once
    ASYMMETRY,  # friction times (1 + a) towards +, (1 - a) towards -
    BUMP_FORCE,
    BUMP_X,
    BUMP_WIDTH,
    SEAL_MU,  # friction per pressure-difference force across the piston
    DAMPER_DRAG,  # extra friction of the stay with the damper mounted
    # loads on the stay
    MESH_FORCE,
    PULL_FORCE,
    X_MESH,
    W_MESH,
    W_PULL,
    X_BLOCK,
    SYNC_IMPULSE,
    SPRING_K,
    SPRING_X0,
    F_EXTERNAL,
    DETENT_FORCE,
    DETENT_WIDTH,
    # stops
    RESTITUTION,
    STOP_OFFSET,  # the engaged stop has moved outward by this much
    # leaks, as orifice areas C_d A
    LEAK_PISTON,
    LEAK_ATM,
    # supply line
    LINE_VOLUME,
    LINE_CDA,
    # process exponents against speed
    ALPHA_SPEED_M1,  # slope of alpha_m1 against the piston's speed, and of the others
    ALPHA_SPEED,
    ALPHA_SPEED_M2,
    ALPHA_SPEED_2,
    ALPHA_V0,  # speed beyond which the exponents change no further; 0: they go on
    # oil damper
    A_OIL,
    A_SMALL,
    A_LARGE,
    R_HOLE,
    X_HOLE,
    RHO_OIL,
    KAPPA,
    AIR_FRACTION,
    V_OIL,
    CD_FLOOR,
    CD_SLOPE,
    # a smooth non-parametric term: which equation, which variable, number of nodes
    TERM_EQUATION,
    TERM_VARIABLE,
    TERM_LOW,
    TERM_STEP,
    TERM_COUNT,
    TERM_0,
) = range(78)
TERM_NODES = 24
PARAMETERS = TERM_0 + TERM_NODES

# --- flow maps: c = charge and discharge polynomials ------------------------------------------
C_Y_MIN, C_Y_SPLIT, C_HIGH, C_LOW, C_SLOPE = 0, 1, 2, 6, 11  # charge: 4 high, 5 low, phi'(1)
D_Z_SPLIT, D_LOW, D_HIGH, D_SLOPE = 12, 13, 18, 21  # discharge: 5 low, 3 high, phi'(1)
FLOW_COEFFICIENTS = 22
