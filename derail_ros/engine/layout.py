"""Columns of the engine's plain arrays.

Kernels take a few arrays with one row a car instead of many small ones: a car's numbers lie
together in memory and compile times stay short. SI units throughout.
"""

from __future__ import annotations

# --- par: scalars of the run -----------------------------------------------------------------
GRAVITY = 0
BRAKE_RISE = 1  # s
BRAKE_SPEED = 2  # signal, m/s
VENT = 3  # 1: a parted coupling vents the pipe
G_CS = 4
G_CD = 5
G_EPS = 6
G_CV = 7
G_SCALE = 8
C_FMAX = 9
C_DC = 10
C_BUFFER = 11
C_C1 = 12
C_C2 = 13
C_C3 = 14
C_BEGIN = 15
C_END = 16
C_HOLD = 17
C_LAW = 18  # 0 gaussian, 1 lorentzian
LV_LIMIT = 19
BREAK_FOLLOWS = 20
RTOL = 21
PROJECT = 22  # 1: projection, 0: Baumgarte
B_VEL = 23
B_POS = 24
LOCATE = 25
STEP_SHARE = 26  # m that a corner may move in one step
H_MAX = 27
H_MIN = 28
REST_V = 29
REST_W = 30
REST_HOLD = 31
T_LIMIT = 32
JOINT_HELD = 33  # 1: moment held beyond its largest value, see laws.joint
WHOLE_CAR = 34  # 1: a car leaves the rails whole as its front truck passes a break
COLLIDE = 35
N_PAR = 36

# --- car: parameters of a body ---------------------------------------------------------------
MASS = 0
INERTIA = 1
IC = 2  # coupler inertia
HALF_L = 3
HALF_W = 4
DP = 5
DT = 6
DCF = 7  # coupler length, front
DCR = 8
ARM = 9  # front striker
OPEN = 10
K1 = 11
K2 = 12
DAMP = 13
REAR = 5  # further on: the same of the rear striker
RADIUS = 19  # of the circle around the rectangle
VIRTUAL = 20
DIST = 21  # arc length of the centre behind car 1's
GYRATION = 22  # sqrt(I / m)
GYRATION_C = 23  # sqrt(I_c / m)
N_CAR = 24

# --- knuckle: one row a coupling -------------------------------------------------------------
KN_0 = 0  # moment polynomial, N m
KN_1 = 1
KN_2 = 2
KN_ROOT = 3
KN_LIMIT = 4
KN_WIDENING = 5  # rad, for the held moment
KN_TOP = 6
N_KN = 7

# --- unit: brake units -----------------------------------------------------------------------
U_BODY = 0
U_DIST = 1  # arc length behind car 1, m
U_FORCE = 2  # F0 K_b, N
U_SHOE = 3  # 0 none, 1 composition, 2 cast iron
U_TRACTION = 4  # mu_t m g, N
U_DELAY = 5
U_NUMBER = 6  # car number in the real train
N_UNIT = 7
# arrival times of a unit, by kind of application
ARR_CONV = 0
ARR_INST = 1
ARR_TL = 2
ARR_INST_TL = 3

# --- lateral: initiating forces --------------------------------------------------------------
LF_CAR = 0
LF_OFFSET = 1  # along the car's axis from the mass centre, m
LF_X = 2
LF_Y = 3
LF_T0 = 4
LF_T1 = 5
N_LF = 6

# --- track: pieces of alignment --------------------------------------------------------------
TR_S = 0
TR_LEN = 1
TR_X = 2
TR_Y = 3
TR_PSI = 4
TR_K = 5
TR_DK = 6  # change of curvature per metre
N_TR = 7

# --- clock: times and extremes of a run ------------------------------------------------------
T = 0
T_PREV = 1
H_NEXT = 2
REST_SINCE = 3
DURATION = 4
MAX_GAP = 5
MAX_OFFSET = 6
E_INITIAL = 7
MAX_RESIDUAL = 8
T_ON = 9  # moment that decides which switched forces are on in this step
N_CLOCK = 10

# --- cnt: counters ---------------------------------------------------------------------------
STEP = 0
REJECTED = 1
N_PAIRS = 2
N_EVENTS = 3  # rows in the event buffer
N_CONTACTS = 4
STATUS = 5
REBUILDS = 6
LIMIT_ACCURACY = 7  # steps whose size the error control set
LIMIT_CAP = 8  # ... the cap on a corner's way
LIMIT_MOMENT = 9  # ... a moment: a switched force or a located event
EVALS = 10
IMPLICIT_STEPS = 11
LIMIT_STABILITY = 12  # ... the stability of an explicit method under friction
LIMIT_LARGEST = 13  # ... the largest step
N_CNT = 14

RUNNING = 0
AT_REST = 1
TIME_LIMIT = 2
VOID = 3
FAILED = 4

# --- energy: work entries, integrated with the state ------------------------------------------
E_BRAKE = 0
E_GROUND_TRUCK = 1
E_GROUND_BODY = 2
E_COLLISION = 3
E_DAMPER = 4
E_EXTERNAL = 5  # put in
N_POWER = 6
E_KNUCKLE = 6  # released at parting
E_STAB_NET = 7
E_STAB_GROSS = 8
N_ENERGY = 9

# --- pair: contact bookkeeping, one row a neighbouring pair ------------------------------------
P_FX = 0  # force on the first car
P_FY = 1
P_FMAX = 2  # largest single-corner force
P_CORNER = 3  # 0-3 corner of the first car, 4-7 of the second
P_X = 4
P_Y = 5
P_NX = 6  # direction of the force on the first car
P_NY = 7
P_CLOSING = 8
P_POWER = 9  # power taken out
P_ID = 10  # row of the contact in progress, -1 without
P_BELOW = 11  # since when the force has been below the end level
P_LAST_POWER = 12
P_NEAR = 13  # the rectangles' buffers overlapped at the last evaluation
P_LAST_FMAX = 14  # at the last accepted state
N_PAIR = 15

# --- contact: one row a collision event ----------------------------------------------------------
K_A = 0
K_B = 1
K_CORNER_CAR = 2
K_CORNER = 3
K_START = 4
K_ENDT = 5
K_PEAK = 6
K_PEAK_T = 7
K_RES = 8
K_RES_T = 9
K_CLOSING = 10
K_X = 11
K_Y = 12
K_NX = 13
K_NY = 14
K_ANGLE = 15
K_ENERGY = 16
K_STAGE = 17  # 0 rising, 1 peak passed, 2 ended
K_VERSION = 18  # grows at each peak passed and at the end
N_CONTACT = 19

# --- peak: one row a car ---------------------------------------------------------------------
PK_F = 0
PK_T = 1
PK_OTHER = 2
PK_DERAIL_T = 3
PK_DERAIL_V = 4
PK_RESTING = 5
N_PEAK = 6

# --- event rows ------------------------------------------------------------------------------
V_KIND = 0
V_TIME = 1
V_CAR = 2
V_CAR2 = 3
V_END = 4  # 0 none, 1 front, 2 rear
V_CAUSE = 5
V_X = 6
V_Y = 7
V_S = 8
V_SPEED = 9
V_VALUE = 10
V_STEP = 11
N_EVENT = 12

CAUSE_NONE = 0
CAUSE_INITIAL = 1
CAUSE_BREAK = 2
CAUSE_LATERAL = 3
CAUSE_ANGLE = 4
CAUSE_COMMAND = 5
CAUSE_VENT = 6
CAUSE_SIGNAL = 7

# --- work: scratch of the solver, one row a car --------------------------------------------------
W_CT = 0  # cos, sin of theta, alpha, beta
W_ST = 1
W_CA = 2
W_SA = 3
W_CB = 4
W_SB = 5
W_M = 6  # inverse (effective) mass of (X, Y, theta): xx xy xt yy yt tt
W_IA = 12  # inverse inertia of front and rear coupler
W_IB = 13
W_W = 14  # mobility of (X, Y, theta) with the trucks' rows eliminated
W_F = 20  # mobility times front and rear attachment: 3 x 2 each
W_B = 26
W_TRUCK = 32  # truck rows: nx, ny, arm; front, rear
W_P = 38  # M^-1 J^T G^-1, 3 x 2
W_G = 44  # G^-1: ff fr rr
W_D = 47  # inverse of the eliminated diagonal block of the coupling behind: xx xy yy
W_L = 50  # block that ties it to the coupling in front: 2 x 2
W_CURVE = 54  # kappa / (1 - kappa d) at the trucks
W_OFF = 56  # truck offset front, rear
W_A0 = 58  # free acceleration, 3
W_RX = 61  # eliminated right-hand side
W_RY = 62
W_STIFF = 63  # 1: friction of this car is treated implicitly in this step
W_C = 64  # its damping by (Vx, Vy, yaw rate): xx xy xt yy yt tt
W_SX = 70  # what the implicit stages add to the velocities' change
W_SY = 71
W_SW = 72
N_WORK = 74

# --- report: forces as `sample` gives them, one row a car ----------------------------------------
R_BRAKE = 0
R_TRUCK = 1  # ground force: front x y, rear x y
R_BODY = 5
R_GROUND_MOMENT = 7
R_STRIKER = 8  # front, rear
R_KNUCKLE = 10
R_COLLISION = 11  # x, y, moment
R_EXTERNAL = 14  # x, y, moment
R_CORNER = 17  # four corners: force, gap, closing speed, other car
N_REPORT = 33

# --- trial: a step that is being tried --------------------------------------------------------
TRY_SIZE = 0  # s
TRY_WANTED = 1  # size that error control would have, s
TRY_SWITCH = 2  # next moment at which a force jumps, infinite for a step that ends at another one
TRY_END = 3  # time, s
TRY_ERROR = 4  # in units of the tolerance
TRY_ENERGY = 5  # of the end before it is put onto the constraints, J
TRY_IMPLICIT = 6  # 1: friction was taken implicitly
TRY_LIMIT = 7  # counter of what limits the size
TRY_REJECTED = 8  # 1: a trial of this step was bad
N_TRY = 9
