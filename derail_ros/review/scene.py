"""A scene: the data for a picture of a train at one moment, as plain arrays.

It is made from a simulation, or from a recorded run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.recorded_run import SampledLine
from derail_ros.vocabulary.scene import Line, car_corners, scene_box
from derail_ros.vocabulary.site import Shape

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.vocabulary.outcome import Outcome
    from derail_ros.vocabulary.params import Car
    from derail_ros.vocabulary.simulation import Simulation

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]

OUTLINE = (0, 1, 3, 2)
"""Corners of a car (``vocabulary.status.CORNERS``) in the order of a polygon."""


@dataclass(frozen=True)
class Scene:
    """A train at one moment, N bodies; SI units, index 0 is car 1."""

    pose: F64  # (N, 3) x, y (m) and yaw (rad) of the mass centres
    length: F64  # (N,) bodies, m
    width: F64  # (N,) m
    pivot: F64  # (N,) centre to coupler pivot, m
    truck_on: Bool  # (N, 2) on the rails, front and rear
    coupled: Bool  # (N-1,) coupling behind each car holds
    represents: Int  # (N,) cars that a body stands for; more than 1 is drawn as a stand-in
    coupler: F64  # (N, 2) absolute angles, front and rear, rad; nan where unknown
    coupler_length: F64  # (N, 2) pivot to face, m
    peak_force: F64  # (N,) largest corner force on each car, N; nan where unknown
    track: F64  # (M, 2) centre line through the scene, m
    breaks: F64  # (K, 3) rail breaks: x, y (m) and heading of the track (rad)
    scene_length: float = float("nan")  # box of the derailed cars along the track, m
    scene_width: float = float("nan")  # across the track, m
    straight: bool = True  # the track is straight along +X, so that the box may be drawn
    title: str = ""
    subtitle: str = ""
    site: tuple[Shape, ...] = ()  # what stands beside the track
    numbers: tuple[int, ...] = field(default=())  # car number of each body; 1, 2, ... by default
    cut: tuple[int, ...] = field(default=())  # of each body, of standing cars; 0 by default

    def __post_init__(self) -> None:
        n = len(self.pose)
        shapes = {
            "pose": (n, 3),
            "length": (n,),
            "width": (n,),
            "pivot": (n,),
            "truck_on": (n, 2),
            "coupled": (max(n - 1, 0),),
            "represents": (n,),
            "coupler": (n, 2),
            "coupler_length": (n, 2),
            "peak_force": (n,),
        }
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name}: must have shape {shape}")
        if not self.numbers:
            object.__setattr__(self, "numbers", tuple(range(1, n + 1)))
        if not self.cut:
            object.__setattr__(self, "cut", (0,) * n)

    @property
    def real(self) -> Bool:
        """(N,) the body is one car and does not stand for many."""
        return self.represents == 1

    @property
    def derailed(self) -> Bool:
        """(N,) a truck of the car is off the rails."""
        return ~self.truck_on.all(axis=1)

    @property
    def own(self) -> Bool:
        """(N,) the body is of the train, and none that stood on a second track."""
        return np.array(self.cut) == 0

    @property
    def parted(self) -> Bool:
        """(N-1,) a coupling has parted; there is none between a train and a cut."""
        return ~self.coupled & (np.diff(self.cut) == 0)

    @property
    def state(self) -> Int:
        """(N,) 0 on the rails, 1 derailed and coupled, 2 derailed and uncoupled."""
        return np.where(self.free, 2, np.where(self.derailed, 1, 0))

    @property
    def free(self) -> Bool:
        """(N,) derailed with no coupling left; a missing neighbour counts as parted."""
        held = np.zeros(len(self.pose), dtype=bool)
        held[:-1] |= self.coupled
        held[1:] |= self.coupled
        return self.derailed & ~held

    @property
    def travel(self) -> tuple[float, float]:
        """Direction of travel: that of the track where the derailed cars lie (or the train)."""
        off = self.derailed & self.real & self.own
        middle = self.pose[off if off.any() else slice(None), :2].mean(axis=0)
        a, b = self.track[:-1], self.track[1:]
        along = b - a
        size = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(((middle - a) * along).sum(axis=1) / size, 0.0, 1.0)
        apart = np.linalg.norm(a + share[:, None] * along - middle, axis=1)
        k = int(np.argmin(apart))
        x, y = along[k] / np.sqrt(size[k])
        return float(x), float(y)

    def corners(self) -> F64:
        """(N, 4, 2) corners of the bodies, m, in the order of ``vocabulary.status.CORNERS``."""
        return car_corners(self.pose, self.length, self.width)

    def outlines(self) -> F64:
        """(N, 4, 2) corners of the bodies in the order of a polygon, m."""
        return self.corners()[:, OUTLINE]

    def fronts(self) -> F64:
        """(N, 4, 2) outlines of the front 0.7 m of the bodies (half of a shorter one), m."""
        corners = self.corners()
        share = np.minimum(0.7 / self.length, 0.5)[:, None, None]
        ahead, behind = corners[:, :2], corners[:, 2:]
        return np.concatenate([ahead, ahead + share * (behind - ahead)], axis=1)[:, OUTLINE]

    def pivots(self) -> F64:
        """(N, 2, 2) front and rear coupler pivots, m."""
        u = np.stack([np.cos(self.pose[:, 2]), np.sin(self.pose[:, 2])], axis=-1)
        arm = self.pivot[:, None] * u
        return np.stack([self.pose[:, :2] + arm, self.pose[:, :2] - arm], axis=1)

    def faces(self) -> F64:
        """(N, 2, 2) front and rear coupler faces, m; straight couplers where no angle is known."""
        angle = np.where(np.isfinite(self.coupler), self.coupler, self.pose[:, 2:3])
        u = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * self.coupler_length[..., None]
        u[:, 1] *= -1.0
        return self.pivots() + u


MARGIN = 60.0
"""Track that is drawn beyond the cars at both ends, m."""


def scene_from_simulation(
    simulation: Simulation, title: str = "", subtitle: str = "", time: float | None = None
) -> Scene:
    """The scene of a simulation at its present time, or at one within its last step (s)."""
    sample = simulation.sample(time)
    return make_scene(
        simulation.params.cars,
        sample.plane,
        sample.truck_on,
        sample.coupled,
        coupler=sample.coupler_yaw,
        outcome=simulation.outcome(),
        track=simulation.track,
        breaks=simulation.rail_breaks,
        site=simulation.params.site.shapes(simulation.track),
        title=title,
        subtitle=subtitle,
        cut=simulation.params.cut_numbers,
    )


def make_scene(
    cars: Sequence[Car],
    pose: F64,
    truck_on: NDArray[Any],
    coupled: NDArray[Any],
    *,
    coupler: F64 | None = None,
    outcome: Outcome | None = None,
    track: Line | None = None,
    breaks: Sequence[float] = (),
    site: tuple[Shape, ...] = (),
    title: str = "",
    subtitle: str = "",
    cut: tuple[int, ...] = (),
) -> Scene:
    """A scene from the cars of a run, a state and an outcome.

    ``breaks`` are track coordinates, m. Without a track it is the endless straight along +X.
    """
    pose = np.asarray(pose, dtype=float)
    line = SampledLine() if track is None else track
    n = len(cars)
    box = {}
    if outcome is not None:
        box = {k: getattr(outcome, k) for k in ("scene_length", "scene_width")}
    return Scene(
        pose=pose,
        length=np.array([c.length for c in cars]),
        width=np.array([c.width for c in cars]),
        pivot=np.array([c.pivot_distance for c in cars]),
        truck_on=np.asarray(truck_on, dtype=bool),
        coupled=np.asarray(coupled, dtype=bool),
        represents=np.array([c.represents for c in cars]),
        coupler=np.full((n, 2), np.nan) if coupler is None else np.asarray(coupler, dtype=float),
        coupler_length=np.array([[c.front.length, c.rear.length] for c in cars]),
        peak_force=np.full(n, np.nan) if outcome is None else np.asarray(outcome.car_peak_force),
        track=_track_near(line, pose),
        breaks=np.array([line.point(float(s))[:3] for s in breaks]).reshape(-1, 3),
        straight=line.straight,
        site=site,
        title=title,
        subtitle=subtitle,
        cut=cut,
        **box,
    )


def scene_at(run: RecordedRun, time: float, title: str = "", subtitle: str = "") -> Scene:
    """The scene of a recorded run at a time (s)."""
    i = run.at(time)
    pose = run.pose_at(time)[:, [0, 1, 5]]
    if run.outcome.final and i == len(run.time) - 1:
        length, width = run.outcome.scene_length, run.outcome.scene_width
    else:
        off = run.derailed[i] & run.cars.real & (run.cars.cut == 0)
        corners = car_corners(pose, run.cars.length, run.cars.width)[off]
        length, width, _ = scene_box(run.line, corners, pose[off, 0])
    return Scene(
        pose=pose,
        length=run.cars.length,
        width=run.cars.width,
        pivot=run.cars.pivot,
        truck_on=run.truck_on[i],
        coupled=run.coupled[i],
        represents=run.cars.represents,
        coupler=run.coupler_yaw[i],
        coupler_length=run.cars.coupler,
        peak_force=run.peaks_until(time),
        track=_track_near(run.line, pose),
        breaks=run.line.breaks[run.line.breaks[:, 4] <= time + 1e-9][:, 1:4],
        scene_length=length,
        scene_width=width,
        straight=run.line.straight,
        site=run.site.shapes(run.line),
        title=title,
        subtitle=subtitle,
        cut=tuple(run.cars.cut.tolist()),
    )


def final_scene(run: RecordedRun) -> Scene:
    """The scene at the end of a recording, with its title and outcome."""
    return scene_at(run, float(run.time[-1]), run.title, run.outcome.text)


def _track_near(line: Line, pose: F64) -> F64:
    """(M, 2) the centre line along the cars, m."""
    s = [line.locate(float(x), float(y))[0] for x, y in pose[:, :2]]
    low, high = max(min(s) - MARGIN, line.start), min(max(s) + MARGIN, line.end)
    n = 2 if line.straight else max(2, int((high - low) / 2.0))
    return np.array([line.point(float(u))[:2] for u in np.linspace(low, high, n)])
