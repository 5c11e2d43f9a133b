"""Films and stills in three dimensions, drawn by MuJoCo without a window (EGL or OSMesa)."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.review import drawing
from derail_ros.review.drawing import INK
from derail_ros.review.film import DPI, FilmError, Stage
from derail_ros.review.scene import scene_at
from derail_ros.review.world import COLOURS, World, places
from derail_ros.vocabulary.outcome import derailed

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun

ASPECT = 9.0 / 16.0
AZIMUTH, ELEVATION = 112.0, -28.0
"""Direction in which the camera looks, degrees."""


class Stage3D(Stage):
    """A figure with a picture of MuJoCo's, renewed from time to time.

    Raises
    ------
    FilmError
        MuJoCo is missing, or nothing can draw here.
    """

    def __init__(self, run: RecordedRun, width: int) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")
        try:
            import mujoco
        except ImportError:
            raise FilmError("--view 3d needs MuJoCo: pip install 'derail_ros[spatial]'") from None
        self.run = run
        self._mujoco = mujoco
        world = World.of(run, float(run.time[-1]))
        self._bodies = world.bodies
        self._model = mujoco.MjModel.from_xml_string(world.mjcf(moved=True))
        self._data = mujoco.MjData(self._model)
        self._shells = [self._model.geom(f"body {body.number}").id for body in world.bodies]
        wide, tall = 2 * round(width / 2), 2 * round(width * ASPECT / 2)
        try:
            self._renderer = mujoco.Renderer(self._model, tall, wide)
        except Exception as error:  # of the OpenGL library that it finds, each its own
            raise FilmError(
                f"--view 3d: no OpenGL to draw with ({error}); install EGL or OSMesa "
                "and set MUJOCO_GL"
            ) from None
        self._camera = mujoco.MjvCamera()
        last = scene_at(run, float(run.time[-1]))
        off = last.derailed & last.own
        shown = world.place[off] if off.any() else world.place[:3]
        self._camera.lookat[:] = shown.mean(axis=0)
        size = float(np.ptp(shown[:, :2], axis=0).max()) + 15.0
        self._camera.distance = 0.75 * size
        self._camera.azimuth, self._camera.elevation = AZIMUTH, ELEVATION
        self.figure = drawing.sheet(wide / DPI, tall / DPI, dpi=DPI)
        axes = drawing.place(self.figure, 0.0, 0.0, wide / DPI, tall / DPI)
        axes.set_axis_off()
        self._image = axes.imshow(np.zeros((tall, wide, 3), np.uint8), aspect="auto")
        scale = width / 960
        look: dict[str, Any] = {"ha": "left", "va": "top", "color": INK}
        self.clock = self.figure.text(0.015, 0.97, "", size=13 * scale, weight="bold", **look)
        self.facts = self.figure.text(0.015, 0.915, "", size=9 * scale, **look)
        self.figure.text(
            0.985, 0.97, run.title, size=min(10.0, 620.0 / max(len(run.title), 1)) * scale,
            **(look | {"ha": "right"}),
        )  # fmt: skip

    def show(self, time: float) -> None:
        """Show a time (s)."""
        place, turn = places(self.run, self._bodies, time)
        scene = scene_at(self.run, time)
        state = scene.state
        self._model.geom_rgba[self._shells, :3] = np.array(COLOURS)[state]
        self._data.mocap_pos[:], self._data.mocap_quat[:] = place, turn
        self._mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        self._image.set_data(self._renderer.render())
        self.clock.set_text(f"{time:.2f} s")
        self.facts.set_text(derailed(int((scene.derailed & scene.own).sum())))
