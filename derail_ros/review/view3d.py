"""A recorded run in three dimensions in the browser, with viser.

The page is served by this process, on this machine only. viser's browser client moves the camera:
drag to orbit, right button to pan, wheel to come nearer.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.review.scene import scene_at
from derail_ros.review.world import (
    BED_COLOUR,
    COLOURS,
    GROUND_COLOUR,
    RAIL_COLOUR,
    SLOPE_COLOUR,
    WALL_COLOUR,
    WEDGE,
    bed,
    bodies,
    ground_level,
    part_mesh,
    places,
    rails,
    slopes,
    walls,
)
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.status import CERTAIN_RUPTURE_FORCE

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun

U8 = NDArray[np.uint8]

HOST = "127.0.0.1"
TICK = 1.0 / 30.0
"""Time between two pictures, s."""
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5")
TRUCKS = (42, 42, 45)
HARD = 0.25 * CERTAIN_RUPTURE_FORCE
"""Force at which a car is quite red, N."""
BY = ("state", "force", "contents", "speed")
"""What colours show."""
CONTENTS = ((86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0))


def _mix(share: NDArray[np.float64]) -> U8:
    """Colours from grey to red for shares of 0 to 1: (N, 3)."""
    low, high = np.array([150.0, 155.0, 160.0]), np.array([213.0, 40.0, 0.0])
    return np.asarray(low + np.clip(share, 0.0, 1.0)[:, None] * (high - low), dtype=np.uint8)


def colours(run: RecordedRun, by: str, moment: float) -> U8:
    """Colours of the cars at a time (s): (N, 3)."""
    if by == "force":
        return _mix(run.corner_force[run.at(moment)] / HARD)
    if by == "speed":
        speed = np.linalg.norm(run.velocity[run.at(moment)][:, :3], axis=1)
        return _mix(speed / max(run.initial_speed, 1.0))
    if by == "contents":
        known = sorted({what for what in run.cars.contents if what})
        rows = [
            CONTENTS[known.index(what) % len(CONTENTS)] if what else (150, 155, 160)
            for what in run.cars.contents
        ]
        return np.array(rows, dtype=np.uint8)
    table = (255.0 * np.array(COLOURS)).astype(np.uint8)
    return np.asarray(table[scene_at(run, moment).state], dtype=np.uint8)


class View:
    """The page and what it shows.

    Parameters
    ----------
    run : what is shown
    port : on which it is served; the next free one if it is taken
    """

    def __init__(self, run: RecordedRun, port: int = 8080) -> None:
        import viser

        self.run, self.bodies = run, bodies(run)
        self.time = self.first = float(run.time[0])
        self.last = float(run.time[-1])
        self.server = viser.ViserServer(host=HOST, port=port, label=run.title, verbose=False)
        self._build_scene()
        self._build_controls()
        self.show(self.first)

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server.get_port()}"

    def _build_scene(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("+z")
        ends = np.concatenate(
            [places(self.run, self.bodies, t)[0] for t in (self.first, self.last)]
        )
        low, high = ends[:, :2].min(axis=0), ends[:, :2].max(axis=0)
        middle, size = 0.5 * (low + high), high - low + 400.0
        scene.add_box("/ground", color=tuple(int(255 * v) for v in GROUND_COLOUR),
                      dimensions=(*size, 0.2), cast_shadow=False,
                      position=(*middle, ground_level(self.run) - 0.1))  # fmt: skip
        along = [self.run.line.locate(float(x), float(y))[0] for x, y in ends[:, :2]]
        first, last = min(along) - 100.0, max(along) + 150.0
        for k, slab in enumerate(bed(self.run, first, last)):
            scene.add_box(f"/bed/{k}", color=tuple(int(255 * v) for v in BED_COLOUR),
                          dimensions=slab.size, position=slab.at, wxyz=slab.turn,
                          cast_shadow=False)  # fmt: skip
        for k, slab in enumerate(walls(self.run)):
            scene.add_box(f"/walls/{k}", color=tuple(int(255 * v) for v in WALL_COLOUR),
                          dimensions=slab.size, position=slab.at, wxyz=slab.turn)  # fmt: skip
        for k, wedge in enumerate(slopes(self.run)):
            scene.add_mesh_simple(f"/slopes/{k}", wedge.astype(np.float32),
                                  WEDGE.astype(np.uint32), flat_shading=True, cast_shadow=False,
                                  color=tuple(int(255 * v) for v in SLOPE_COLOUR))  # fmt: skip
        scene.add_line_segments(
            "/rails", rails(self.run, first, last),
            tuple(int(255 * v) for v in RAIL_COLOUR), thickness=0.15,
        )  # fmt: skip
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/sky", intensity=0.9)
        scene.add_light_directional("/sun", intensity=1.6, position=(-40.0, 50.0, 100.0),
                                    cast_shadow=True)  # fmt: skip
        shapes: dict[Any, list[int]] = {}
        for i, body in enumerate(self.bodies):
            shapes.setdefault(tuple(body.parts), []).append(i)
        self.batches = []
        for k, (parts, cars) in enumerate(shapes.items()):
            import trimesh

            meshes = [part_mesh(part) for part in parts]
            for name, mesh in (
                ("body", meshes[0]),
                ("trucks", trimesh.util.concatenate(meshes[1:])),
            ):
                n = len(cars)
                handle = scene.add_batched_meshes_simple(
                    f"/cars/{name} {k}", mesh.vertices.astype(np.float32),
                    mesh.faces.astype(np.uint32), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
                    np.zeros((n, 3)), batched_colors=np.tile(TRUCKS, (n, 1)).astype(np.uint8),
                    flat_shading=not parts[0].capsule or name == "trucks",
                )  # fmt: skip
                self.batches.append((np.array(cars), handle, name == "body"))
        self.labels = [
            scene.add_label(f"/numbers/{body.number}", str(body.number), anchor="bottom-center",
                            visible=False)
            for body in self.bodies
        ]  # fmt: skip

    def _build_controls(self) -> None:
        gui, run = self.server.gui, self.run
        gui.set_panel_label(run.title)
        self.clock = gui.add_markdown("")
        self.slider = gui.add_slider("Time (s)", self.first, self.last, 0.01, self.first)
        self.playing = gui.add_checkbox("Play", True)
        self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
        self.by = gui.add_dropdown("Colours", BY, initial_value="state")
        self.follow = gui.add_number("Follow car", 0, min=0, max=len(self.bodies), step=1,
                                     hint="0: the camera stands")  # fmt: skip
        self.numbered = gui.add_checkbox("Car numbers", False)
        wreck = gui.add_button("View of the wreck")
        top = gui.add_button("From above")
        again = gui.add_button("From the beginning")
        wreck.on_click(lambda event: self._look(event.client, above=False))
        top.on_click(lambda event: self._look(event.client, above=True))
        again.on_click(lambda _: self.show(self.first))
        self.slider.on_update(self._sought)
        self.by.on_update(lambda _: self.show(self.time))
        self.server.on_client_connect(lambda client: self._look(client, above=False))

    def _sought(self, event: Any) -> None:
        if event.client is not None:  # moved by hand, not by `show`
            self.show(float(self.slider.value))

    def _wreck(self) -> tuple[NDArray[np.float64], float]:
        """Middle and size of where the derailed cars come to rest, m."""
        place, _ = places(self.run, self.bodies, self.last)
        scene = scene_at(self.run, self.last)
        off = scene.derailed & scene.own
        shown = place[off] if off.any() else place[:3]
        size = float(np.ptp(shown[:, :2], axis=0).max()) + 15.0
        return shown.mean(axis=0), size

    def _look(self, client: Any, above: bool) -> None:
        """Put a client's camera over or beside the wreck."""
        if client is None:
            return
        middle, size = self._wreck()
        away = np.array([0.0, -0.02, 1.15]) if above else np.array([0.18, -0.52, 0.30])
        client.camera.position = middle + size * away
        client.camera.look_at = middle

    def show(self, moment: float) -> None:
        """Show a time (s)."""
        run = self.run
        before = self.time
        self.time = float(np.clip(moment, self.first, self.last))
        place, turn = places(run, self.bodies, self.time)
        shade = colours(run, self.by.value, self.time)
        with self.server.atomic():
            for cars, handle, coloured in self.batches:
                handle.batched_positions = place[cars].astype(np.float32)
                handle.batched_wxyzs = turn[cars].astype(np.float32)
                if coloured:
                    handle.batched_colors = shade[cars]
            for label, at, body in zip(self.labels, place, self.bodies, strict=True):
                if self.numbered.value or label.visible:
                    label.position = at + [0.0, 0.0, 5.0 - body.height]
                    label.visible = bool(self.numbered.value)
            self.slider.value = self.time
            self.clock.content = self.words()
            number = int(self.follow.value)
            if number:
                moved = place[number - 1] - places(run, self.bodies, before)[0][number - 1]
                for client in self.server.get_clients().values():
                    client.camera.position = client.camera.position + moved
                    client.camera.look_at = place[number - 1]

    def words(self) -> str:
        """Time, cars derailed and the last event, in Markdown."""
        run = self.run
        scene = scene_at(run, self.time)
        off = int((scene.derailed & scene.own).sum())
        told = [
            e for e in run.events
            if e.time <= self.time and e.kind != EventKind.BRAKE_SIGNAL_REACHED
        ]  # fmt: skip
        last = f"\n\n{told[-1].time:.2f} s: {told[-1].text}" if told else ""
        return f"**{self.time:.2f} s** of {self.last:.1f} s, {off} derailed ({run.model}){last}"

    def run_for(self, seconds: float = float("inf")) -> None:
        """Play for that long, by the clock of the wall (s)."""
        end = time.monotonic() + seconds
        last = time.monotonic()
        while time.monotonic() < end:
            time.sleep(TICK)
            now = time.monotonic()
            if self.playing.value and self.time < self.last:
                self.show(self.time + (now - last) * float(self.speed.value))
            last = now
