"""Tables of the engine: what a row of its arrays holds, by name; codes and columns.

A table is a numpy array of records: kernels read ``car[i].mass``, Python reads ``car["mass"]``.
Saved states hold the same numbers as plain arrays, in the order of the fields here. SI units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def _table(text: str, kind: Any = np.float64) -> np.dtype[np.void]:
    """Fields from lines of names; what follows a ``#`` explains them."""
    names = " ".join(line.partition("#")[0] for line in text.splitlines()).split()
    return np.dtype([(name, kind) for name in names])


def named(rows: NDArray[np.void]) -> list[dict[str, float]]:
    """Rows of a table as dictionaries of plain numbers."""
    return [dict(zip(rows.dtype.names or (), row, strict=True)) for row in rows.tolist()]


# Parameters ----------------------------------------------------------------------------------

PAR = _table("""
    gravity
    brake_rise brake_speed vent  # s; of the signal, m/s; 1: a parted coupling vents the pipe
    brake_system radio_delay  # index in params.BRAKE_SYSTEMS; s
    ground_cs ground_cd ground_eps ground_cv ground_scale
    force_max half_distance buffer c1 c2 c3 begin_force end_force end_hold  # of contacts
    reach  # m, gap beyond which no contact has a force
    gap_law even_inside  # numbers of laws.contact.GAP_LAWS and INSIDE
    lv_limit break_follows
    rtol
    project baumgarte_v baumgarte_q  # 1: projection, 0: Baumgarte
    locate
    step_share  # m that a corner may move in one step
    h_max h_min
    rest_speed rest_yaw_rate rest_hold time_limit
    joint_held  # 1: moment held beyond its largest value, see laws.joint
    whole_car  # 1: a car leaves the rails whole as its front truck passes a break
    collide
    along  # 1: forces along the track, see forces.along
    profile datum  # 1: the track has grades; potential energy at the start, J
    curve_resistance  # times mass over radius, m^2/s^2
    cut keep_dynamic  # s in which an emergency cuts the power; 1: not the dynamic brake
    gear  # 1: draft gear along the couplings, see forces.draft_gear
    strength  # 1: couplings break in tension
    lv_hold  # s that a truck must be above lv_limit
    truck_play  # of trucks between the rails, m
    guide_strength guide_stiffness guide_play  # of rails beside derailed trucks, N, N/m, m
    ground_most  # largest static coefficient of any ground
    border slopes  # width of the borders between zones, m; 1: a zone has a slope
    train  # number of the train's own bodies; those behind them stand on second tracks
""")
CAR = _table("""
    mass inertia coupler_inertia
    half_l half_w radius  # of the rectangle, and of the circle around it
    pivot truck  # distance from the centre, m
    front rear  # coupler lengths, m
    virtual
    distance  # arc length of the centre behind car 1's, m
    gyration gyration_c  # sqrt(I / m), sqrt(I_c / m)
    line line_end  # rows of ``Model.side`` that are its second track; none: on the main one
""")
STRIKER = _table("arm free opening k1 k2 damping")  # (N, 2): front, rear
KNUCKLE = _table("""
    c0 c1 c2 root  # moment polynomial, N m
    limit
    widening top  # rad, for the held moment
""")
UNIT = _table("""
    body
    distance  # arc length behind car 1, m
    force  # F0 K_b, N
    shoe  # 0 none, 1 composition, 2 cast iron
    traction  # mu_t m g, N
    delay
    number  # car number in the real train
    hand  # force of the hand brake, N
""")
LINK = _table("""
    slack preload stiffness unloading transition travel solid  # of the draft gear
    strength part  # N; 0 knuckle, 1 coupler body
""")
ALONG = _table("""
    r0 r1 r2  # resistance on straight level track: N, N s/m, N s^2/m^2
    power power_end dynamic dynamic_end  # rows of EFFORT
    setting setting_end  # rows of SETTING; none: no locomotive
""")
EFFORT = _table("speed force")
SETTING = _table("time share")  # of the largest effort; below 0: of the dynamic brake
GRADE = _table("""
    s z grade  # where a piece begins, its height and grade there
    change  # of the grade per metre
""")
PUSH = _table("""
    car
    offset  # along the car's axis from the mass centre, m
    fx fy start end
""")
TRACK = _table("""
    s length x y psi
    kappa dkappa  # curvature and its change per metre
""")

OUTLINE = _table("""
    x y
    ux uy length  # direction and length of the edge to the next vertex; 0 m: the end of a chain
    corner bx by  # 1: it touches the sides of cars; on the side of (bx, by) if that is not 0
    group  # row of GROUP
""")
ZONE = _table("first last closed x0 x1 y0 y1 c_s c_d eps c_v rise_x rise_y")
FIXED = _table("first last closed x0 x1 y0 y1 force")
AREA = _table("first last closed x0 x1 y0 y1")
"""Rows ``first`` to before ``last`` of OUTLINE, and the box around them."""

# State ---------------------------------------------------------------------------------------

CLOCK = _table("""
    t t_prev h_next rest_since duration
    max_gap max_offset initial_energy max_residual
    t_on  # moment that decides which switched forces are on in this step
""")
COUNT = _table(
    """
    steps rejected
    pairs events contacts  # rows in use
    status rebuilds
    by_accuracy by_cap by_moment  # steps by what set their size
    evaluations implicit
    by_stability by_largest
""",
    np.int64,
)
PAIR = _table("""
    fx fy  # force on the first car
    peak corner x y nx ny closing  # largest single-corner force; corner 4-7: of the second car
    power  # taken out
    contact  # row of the contact in progress, -1 without
    below  # since when the force has been below the end level
    last_power
    near  # the rectangles' buffers overlapped at the last evaluation
    last_peak  # at the last accepted state
""")
CONTACT = _table("""
    a b corner_car corner  # a struck b
    start end
    peak peak_time resultant resultant_time closing
    x y nx ny angle energy
    stage  # 0 rising, 1 peak passed, 2 ended
    version  # grows at each peak passed and at the end
""")
COUPLING = _table("""
    draft draft_time buff buff_time  # largest so far, N >= 0
    travel share  # of the draft gear at the last accepted state: m; friction's, -1 to 1
    travel0 share0  # at the one before
""")
GROUP = _table("""
    energy power last  # J; taken out; at the last accepted state
    limit  # J
    gone  # 1: it has given way
""")
PEAK = _table("force time other derail_time derail_speed resting")

# Scratch -------------------------------------------------------------------------------------

EVENT = _table("""
    kind time car car2
    end  # 0 none, 1 front, 2 rear
    cause x y s speed value step
""")
WORK = _table("""
    ct st ca sa cb sb  # cos, sin of theta, alpha, beta
    m_xx m_xy m_xt m_yy m_yt m_tt  # inverse (effective) mass of (X, Y, theta)
    m_front m_rear  # inverse inertia of the coupler bodies
    w_xx w_xy w_xt w_yy w_yt w_tt  # mobility of (X, Y, theta) with the trucks' rows eliminated
    fx_x fx_y fx_t fy_x fy_y fy_t  # mobility times the front attachment, along x and y
    bx_x bx_y bx_t by_x by_y by_t  # the same of the rear attachment
    p_fx p_fy p_ft p_rx p_ry p_rt  # M^-1 J^T G^-1, front and rear truck
    g_ff g_fr g_rr  # G^-1
    d_xx d_xy d_yy  # inverse of the eliminated diagonal block of the coupling behind
    l_xx l_xy l_yx l_yy  # block that ties it to the coupling in front
    rx ry  # eliminated right-hand side
    reach  # length of the rear coupler with the travel of the draft gear, m
    stiff  # 1: friction of this car is treated implicitly in this step
    c_xx c_xy c_xt c_yy c_yt c_tt  # its damping by (Vx, Vy, yaw rate)
    sx sy sw  # what the implicit stages add to the velocities' change
    ct0 st0  # cos, sin of theta at the beginning of the step
    settled composition cast_iron  # 1: its brakes stay as they are in the step: of its shoes, N
    block  # mass of the block that it leads, with implicit friction, kg
""")
ROW = _table("""
    nx ny arm  # row of J
    curve  # kappa / (1 - kappa d)
    offset  # d, m
""")  # (N, 2): front, rear truck
TRIAL = _table("""
    size
    wanted  # size that error control would have, s
    switch  # next moment at which a force jumps; infinite for a step that ends at another one
    end  # time, s
    error  # in units of the tolerance
    energy  # of the end before it is put onto the constraints, J
    implicit  # 1: friction was taken implicitly
    limit  # what sets the size
    rejected  # 1: a trial of this step was bad
    scope  # number of the cars that its stages look at
    mass damping  # of the cars behind those: kg, and of implicit friction along the track, kg/s
    settled composition cast_iron  # their brakes, as a car's in WORK
""")

# Codes ---------------------------------------------------------------------------------------

RUNNING, AT_REST, TIME_LIMIT, VOID, FAILED = range(5)

(CAUSE_NONE, CAUSE_INITIAL, CAUSE_BREAK, CAUSE_LATERAL, CAUSE_ANGLE, CAUSE_COMMAND, CAUSE_VENT,
 CAUSE_SIGNAL, CAUSE_KNUCKLE, CAUSE_BODY) = range(10)  # fmt: skip

BY_ACCURACY, BY_CAP, BY_MOMENT, BY_STABILITY, BY_LARGEST = range(5)
"""What sets the size of a step: error control, the cap on a corner's way, a moment (a switched
force or a located event), the stability of an explicit method, the largest step."""

# Columns -------------------------------------------------------------------------------------

ARR_CONV, ARR_INST, ARR_TL, ARR_INST_TL = range(4)
"""Arrival times of a brake unit, by kind of application."""

(E_BRAKE, E_GROUND_TRUCK, E_GROUND_BODY, E_COLLISION, E_DAMPER, E_EXTERNAL, E_TRACTION, E_DYNAMIC,
 E_RESISTANCE, E_GEAR, E_GUIDANCE, E_SLOPE, E_FIXED) = range(13)  # fmt: skip
N_POWER = 13
E_KNUCKLE, E_STAB_NET, E_STAB_GROSS = range(13, 16)
N_ENERGY = 16
"""Work entries of the ledger. The first thirteen are integrated with the state; E_EXTERNAL and
E_TRACTION are put in, E_KNUCKLE is released at parting."""

R_BRAKE = 0
R_TRUCK = 1  # ground force: front x y, rear x y
R_BODY = 5
R_GROUND_MOMENT = 7
R_STRIKER = 8  # front, rear
R_KNUCKLE = 10
R_COLLISION = 11  # x, y, moment
R_EXTERNAL = 14  # x, y, moment
R_ALONG = 17  # grade, resistance, locomotive
R_CORNER = 20  # four corners: force, gap, closing speed, other car
N_REPORT = 36
"""Forces as ``sample`` gives them, one row a car."""
