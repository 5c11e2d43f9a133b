"""The model written a second time, slowly and another way, for the tests to compare with.

Nothing of the engine is used but the parameter objects. The constraints are plain functions of the
coordinates; their Jacobian comes by complex steps and their second derivative by differences. The
multipliers come from one dense system. The line is integrated with Fresnel functions, contacts are
found from the vertices and edges of the rectangles in the plane.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve
from scipy.special import fresnel

from derail_ros.engine.negotiability import free_swing
from derail_ros.engine.track import Track

G = 9.81

KNUCKLE = {
    "EE": (-203.08e3, 1061.7e3, -455.87e3),
    "FF": (-762.77e3, 3536.2e3, -2777.1e3),
    "EF": (-482.925e3, 2298.95e3, -1616.485e3),
}


class Line:
    """Centre line from clothoids, in closed form; takes complex coordinates."""

    def __init__(self, track):
        self.pieces = []
        s, z, psi = track.start_coordinate, complex(track.start_x, track.start_y), 0.0
        psi = track.start_heading
        for seg in track.segments:
            slope = (seg.curvature_end - seg.curvature_start) / seg.length
            piece = (s, z, psi, seg.curvature_start, slope)
            self.pieces.append(piece)
            x, y = self._from(piece, seg.length)
            z = complex(x, y)
            s += seg.length
            psi += 0.5 * (seg.curvature_start + seg.curvature_end) * seg.length

    @staticmethod
    def _from(piece, u):
        _, z, psi, kappa, slope = piece
        if slope == 0.0 and kappa == 0.0:
            return z.real + u * math.cos(psi), z.imag + u * math.sin(psi)
        if slope == 0.0:
            x = z.real + (np.sin(psi + kappa * u) - math.sin(psi)) / kappa
            return x, z.imag - (np.cos(psi + kappa * u) - math.cos(psi)) / kappa
        k = math.sqrt(abs(slope) / math.pi)
        s1, c1 = fresnel(k * (u + kappa / slope))
        s0, c0 = fresnel(k * kappa / slope)
        a = psi - kappa**2 / (2.0 * slope)
        c, s = (c1 - c0) / k, math.copysign(1.0, slope) * (s1 - s0) / k
        x = z.real + math.cos(a) * c - math.sin(a) * s
        return x, z.imag + math.sin(a) * c + math.cos(a) * s

    def at(self, s):
        """Place, heading and curvature at the coordinate ``s``, which may be complex."""
        if not self.pieces:
            return s, 0.0 * s, 0.0, 0.0
        piece = self.pieces[0]
        for p in self.pieces:
            if p[0] <= np.real(s):
                piece = p
        u = s - piece[0]
        x, y = self._from(piece, u)
        return x, y, piece[2] + piece[3] * u + 0.5 * piece[4] * u * u, piece[3] + piece[4] * u

    def foot(self, x, y, s):
        """Coordinate and signed offset of a point, by Newton's method from ``s``."""
        if not self.pieces:
            return x, y
        for _ in range(50):
            px, py, h, kappa = self.at(s)
            e = (x - px) * np.cos(h) + (y - py) * np.sin(h)
            d = -(x - px) * np.sin(h) + (y - py) * np.cos(h)
            s = s + e / (1.0 - kappa * d)
            if abs(e) < 1e-9:
                break
        px, py, h, _ = self.at(s)
        return s, -(x - px) * np.sin(h) + (y - py) * np.cos(h)


def spring(x, free, opening, k1, k2):
    """Bilinear restoring force beyond a free play."""
    inner = np.clip(x, -opening, opening)
    return k1 * (inner - np.clip(x, -free, free)) + k2 * (x - inner)


def knuckle(n, c0, c1, c2):
    """Moment against the angle, zero up to the smaller root of its polynomial."""
    root = min(np.roots([c2, c1, c0]).real)
    u = abs(n)
    return -np.sign(n) * (c0 + c1 * u + c2 * u * u) if u > root else 0.0


def corner_list(x, y, theta, length, width):
    """Corners in the plane: front left, front right, rear left, rear right."""
    e = np.array([math.cos(theta), math.sin(theta)])
    n = np.array([-e[1], e[0]])
    p = np.array([x, y])
    return [p + a * length / 2 * e + b * width / 2 * n for a in (1, -1) for b in (1, -1)]


AROUND = (0, 2, 3, 1)
"""Corners in counter-clockwise order: front left, rear left, rear right, front right."""


def closest(point, corners):
    """What faces an outer point: ("wall", foot, gap) or ("corner", number, gap)."""
    inside = True
    for a, b in zip(AROUND, AROUND[1:] + AROUND[:1]):
        e = corners[b] - corners[a]
        length = np.hypot(*e)
        e = e / length
        out = np.array([e[1], -e[0]])
        along, gap = (point - corners[a]) @ e, (point - corners[a]) @ out
        if gap >= 0.0:
            inside = False
            if 0.0 <= along <= length:
                return "wall", point - gap * out, gap
    assert not inside, "the reference has no case for penetration"
    gaps = [np.hypot(*(point - c)) for c in corners]
    k = int(np.argmin(gaps))
    return "corner", k, gaps[k]


def touching(a, b, buffer):
    """Contacts of two rectangles: (place on a, place on b, gap)."""
    found = []
    for i, p in enumerate(a):
        kind, what, gap = closest(p, b)
        if gap >= buffer:
            continue
        if kind == "wall":
            found.append((p, what, gap))
        else:
            back, k, _ = closest(b[what], a)
            if back == "corner" and k == i:
                found.append((p, b[what], gap))
    for p in b:
        kind, what, gap = closest(p, a)
        if kind == "wall" and gap < buffer:
            found.append((what, p, gap))
    return found


class Reference:
    """The equations of motion of a run."""

    def __init__(self, params, truck_on=None, coupled=None):
        self.p = params
        self.n = n = len(params.cars)
        self.line = Line(params.track)
        self.free = free_swing(params.cars, Track(params.track))
        self._last = {}
        self.truck_on = np.ones((n, 2), bool) if truck_on is None else np.array(truck_on, bool)
        self.coupled = np.ones(n - 1, bool) if coupled is None else np.array(coupled, bool)
        if truck_on is None:
            for number, end in params.initiation.derailed_trucks:
                self.truck_on[number - 1, ("front", "rear").index(end)] = False
        if coupled is None:
            for number in params.initiation.parted_couplings:
                self.coupled[number - 1] = False
        cars = params.cars
        self.mass = np.array(
            [[c.mass, c.mass, c.inertia, c.coupler_inertia, c.coupler_inertia] for c in cars]
        ).ravel()
        self.arrivals = [self._arrivals(t) for t in params.brakes.triggers]

    # --- constraints -------------------------------------------------------------------------

    def phi(self, q):
        """All constraints of one set of coordinates (n, 5): trucks in order, then couplings."""
        rows = []
        cars = self.p.cars
        for i, c in enumerate(cars):
            for k, r in enumerate((c.truck_distance, -c.truck_distance)):
                if self.truck_on[i, k]:
                    x = q[i, 0] + r * np.cos(q[i, 2])
                    y = q[i, 1] + r * np.sin(q[i, 2])
                    rows.append(self.foot(i, k, x, y)[1])
        for i in range(self.n - 1):
            if self.coupled[i]:
                a, b = cars[i], cars[i + 1]
                for trig, k in ((np.cos, 0), (np.sin, 1)):
                    back = q[i, k] - a.pivot_distance * trig(q[i, 2])
                    back -= a.rear.length * trig(q[i, 4])
                    front = q[i + 1, k] + b.pivot_distance * trig(q[i + 1, 2])
                    front += b.front.length * trig(q[i + 1, 3])
                    rows.append(back - front)
        return np.array(rows)

    def foot(self, i, k, x, y):
        """Track coordinate and offset of a truck at (x, y), sought from where it was last."""
        if not self.line.pieces:
            return x, y
        if (i, k) not in self._last:
            end = self.line.pieces[-1][0] + self.p.track.segments[-1].length
            grid = np.arange(self.line.pieces[0][0], end, 2.0)
            points = np.array([self.line.at(float(s))[:2] for s in grid])
            distance = np.hypot(points[:, 0] - np.real(x), points[:, 1] - np.real(y))
            self._last[i, k] = grid[np.argmin(distance)]
        s, d = self.line.foot(x, y, self._last[i, k])
        self._last[i, k] = float(np.real(s))
        return s, d

    def jacobian(self, q):
        """d phi / d q by complex steps: exact to rounding."""
        h = 1e-30
        columns = []
        for k in range(5 * self.n):
            z = q.astype(complex).ravel()
            z[k] += 1j * h
            columns.append(self.phi(z.reshape(self.n, 5)).imag / h)
        return np.array(columns).T.reshape(-1, 5 * self.n)

    def rate(self, q, v):
        """d phi / dt."""
        return self.phi(q + 1e-30j * v).imag / 1e-30

    def gamma(self, q, v):
        """What J qdd must be: less the second derivative of phi along a straight path."""
        h = 2e-3 / (1.0 + float(np.max(np.abs(v[:, 2:]), initial=0.0)))
        terms = 0.0
        for k, w in ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60)):
            terms = terms + w * (self.rate(q + k * h * v, v) - self.rate(q - k * h * v, v))
        return -terms / h if np.ndim(terms) else np.zeros(0)

    # --- forces ------------------------------------------------------------------------------

    def _arrivals(self, trigger):
        units = [u for c in self.p.cars for u in c.brakes]
        first, last = min(u.distance for u in units), max(u.distance for u in units)
        places = {"front": [first], "rear": [last], "both_ends": [first, last]}.get(
            trigger.source
        ) or [self.p.cars[trigger.car - 1].brakes[0].distance]
        out = []
        for u in units:
            way = 0.0
            if not trigger.mode.startswith("instant"):
                way = min(abs(u.distance - s) for s in places) / self.p.brakes.signal_speed
            out.append(trigger.time + trigger.delay + way + u.delay)
        return out

    def brake(self, i, t, speed):
        """Brake force of car ``i`` with all wheels on the rails."""
        b = self.p.brakes
        before = sum(len(c.brakes) for c in self.p.cars[:i])
        total = 0.0
        for k, unit in enumerate(self.p.cars[i].brakes):
            if unit.shoe == "none":
                continue
            u = min(speed, 80 / 3.6)
            f = b.force * unit.scale * ((u + 19.223) / (u + 9.388)) / (19.223 / 9.388)
            assert unit.shoe == "composition"
            best = 0.0
            for trigger, arrivals in zip(b.triggers, self.arrivals):
                at = arrivals[before + k]
                if trigger.mode.startswith("instant"):
                    share = 1.0 if t >= at else 0.0
                else:
                    share = min(max((t - at) / b.rise_time, 0.0), 1.0)
                full = f
                if "traction" in trigger.mode:
                    full = b.traction_coefficient * unit.weight * G
                best = max(best, share * full)
            total += best
        return total

    def resistance(self, speed):
        """Ground force per newton of load."""
        g = self.p.ground
        k = g.c_d + (g.c_s - g.c_d) * math.exp(-speed / g.eps) + g.c_v * speed
        return g.scale * k

    def forces(self, t, q, v):
        """Generalized forces (n, 5)."""
        p = self.p
        out = np.zeros((self.n, 5))

        def push(i, place, force):
            out[i, :2] += force
            arm = place - q[i, :2]
            out[i, 2] += arm[0] * force[1] - arm[1] * force[0]

        def velocity(i, place):
            arm = place - q[i, :2]
            return v[i, :2] + v[i, 2] * np.array([-arm[1], arm[0]])

        def on_axis(i, r):
            return q[i, :2] + r * np.array([math.cos(q[i, 2]), math.sin(q[i, 2])])

        for i, c in enumerate(p.cars):
            for end, (col, e) in enumerate(((3, c.front), (4, c.rear))):
                x = e.striker_arm * (q[i, col] - q[i, 2])
                xd = e.striker_arm * (v[i, col] - v[i, 2])
                law = e.striker_arm * self.free[i, end], e.striker_opening, e.k1, e.k2
                m = e.striker_arm * (spring(x, *law) + e.damping * xd)
                out[i, col] -= m
                out[i, 2] += m
            smooth = math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + p.ground.eps**2)
            share = self.truck_on[i].sum() / 2.0
            f = share * self.brake(i, t, math.hypot(*v[i, :2]))
            out[i, :2] -= f * v[i, :2] / smooth
            alone = (i == 0 or not self.coupled[i - 1]) and (
                i == self.n - 1 or not self.coupled[i]
            )
            places = []
            if not self.truck_on[i].all():
                if alone:
                    step = c.length / 10.0
                    places = [(k - 4.5) * step for k in range(10)]
                    load = c.mass * G / 10.0
                else:
                    ends = (c.truck_distance, -c.truck_distance)
                    places = [r for k, r in enumerate(ends) if not self.truck_on[i, k]]
                    load = c.mass * G / 2.0
            for r in places:
                place = on_axis(i, r)
                u = velocity(i, place)
                speed = math.hypot(*u)
                drag = self.resistance(speed) * load / math.hypot(speed, p.ground.eps)
                push(i, place, -drag * u)
        for i in range(self.n - 1):
            if self.coupled[i]:
                heads = "".join(sorted(p.cars[i].rear.head + p.cars[i + 1].front.head))
                m = knuckle(q[i, 4] - q[i + 1, 3], *KNUCKLE[heads])
                out[i, 4] += m
                out[i + 1, 3] -= m
        for f in p.initiation.lateral_forces:
            if f.start <= t < f.start + f.duration:
                assert not self.line.pieces
                c = p.cars[f.car - 1]
                r = {"front": c.truck_distance, "rear": -c.truck_distance}.get(f.place, 0.0)
                push(f.car - 1, on_axis(f.car - 1, r), np.array([0.0, f.force]))
        law = p.contact
        if law.c1 == law.c2 == law.c3 == 0.0:
            return out
        for i in range(self.n):
            for j in range(i + 1, self.n):
                a, b = p.cars[i], p.cars[j]
                if a.represents > 1 or b.represents > 1:
                    continue
                reach = math.hypot(a.length, a.width) + math.hypot(b.length, b.width)
                if np.hypot(*(q[i, :2] - q[j, :2])) > 0.5 * reach + law.buffer:
                    continue
                ca = corner_list(*q[i, :3], a.length, a.width)
                cb = corner_list(*q[j, :3], b.length, b.width)
                for pa, pb, gap in touching(ca, cb, law.buffer):
                    normal = (pa - pb) / gap
                    closing = (velocity(j, pb) - velocity(i, pa)) @ normal
                    f = law.force_max * 2.0 ** (-((gap / law.half_distance) ** 2))
                    factor = law.c1 * closing * abs(closing) + law.c2 * closing + law.c3
                    push(i, pa, f * max(factor, 0.0) * normal)
                    push(j, pb, -f * max(factor, 0.0) * normal)
        return out

    # --- motion ------------------------------------------------------------------------------

    def solve(self, force, jacobian, gamma):
        """Accelerations (n, 5) and multipliers from one dense system, scaled by the masses."""
        m = len(gamma)
        root = np.sqrt(self.mass)
        j = jacobian / root
        # rows scaled to one as well: lambda = s mu
        s = 1.0 / np.sqrt((j * j).sum(axis=1))
        j = j * s[:, None]
        size = len(root)
        kkt = np.block([[np.eye(size), -j.T], [j, np.zeros((m, m))]])
        x = solve(kkt, np.concatenate([force.ravel() / root, gamma * s]))
        return (x[:size] / root).reshape(-1, 5), x[size:] * s

    def accelerations(self, t, q, v):
        """Accelerations and multipliers at a state."""
        force = self.forces(t, q, v)
        if not (self.truck_on.any() or self.coupled.any()):
            return force / self.mass.reshape(-1, 5), np.zeros(0)
        return self.solve(force, self.jacobian(q), self.gamma(q, v))

    def split(self, multipliers):
        """Multipliers as the engine orders them: (n, 2) on trucks, (n - 1, 2) in couplings."""
        trucks, couplings = np.zeros((self.n, 2)), np.zeros((self.n - 1, 2))
        count = int(self.truck_on.sum())
        trucks[self.truck_on] = multipliers[:count]
        couplings[self.coupled] = multipliers[count:].reshape(-1, 2)
        return trucks, couplings

    def run(self, q, v, until, rtol=1e-10, max_step=np.inf):
        """Integrate the index-1 equations with an eighth-order method, piece by smooth piece.

        Trucks are removed where they pass a break. Returns the coordinates and velocities at
        ``until`` and the passages ``(time, car, truck)``.
        """
        n = self.n

        def rhs(t, y):
            q, v = y.reshape(2, n, 5)
            return np.concatenate([v.ravel(), self.accelerations(t, q, v)[0].ravel()])

        def passing(i, k, s):
            r = self.p.cars[i].truck_distance * (1 - 2 * k)

            def event(t, y):
                x, yy, theta = y[5 * i : 5 * i + 3]
                x, yy = x + r * math.cos(theta), yy + r * math.sin(theta)
                return self.foot(i, k, x, yy)[0] - s

            event.terminal = True
            event.direction = 1.0
            return event

        kinks = [f.start + f.duration for f in self.p.initiation.lateral_forces]
        kinks += [a for arrivals in self.arrivals for a in arrivals]
        kinks += [a + self.p.brakes.rise_time for arrivals in self.arrivals for a in arrivals]
        stops = sorted({k for k in kinks if 0.0 < k < until} | {until})
        passed = []
        t, y = 0.0, np.concatenate([q.ravel(), v.ravel()])
        while t < until:
            trucks = np.argwhere(self.truck_on).tolist()
            events = [passing(i, k, s) for i, k in trucks for s in self.p.track.rail_breaks]
            stop = min(s for s in stops if s > t)
            # forces that end at the stop are on up to it
            solution = solve_ivp(
                rhs, (t, np.nextafter(stop, 0.0)), y, method="DOP853", rtol=rtol, atol=1e-11,
                events=events, max_step=max_step,
            )  # fmt: skip
            t, y = solution.t[-1], solution.y[:, -1]
            if solution.status == 1:
                hit = next(j for j, e in enumerate(solution.t_events) if len(e))
                i, k = trucks[hit // len(self.p.track.rail_breaks)]
                self.truck_on[i, k] = False
                passed.append((t, i + 1, ("front", "rear")[k]))
            else:
                t = stop
        return *y.reshape(2, n, 5), passed
