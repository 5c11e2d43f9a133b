"""A film of a run, seen from above: MP4 with ffmpeg, GIF with Pillow."""

from __future__ import annotations

import logging
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.patheffects import withStroke
from PIL import Image

from derail_ros.review import drawing
from derail_ros.review.drawing import INK, STYLE, VERMILION
from derail_ros.review.scene import Scene, final_scene, scene_at
from derail_ros.review.summary import NOTABLE
from derail_ros.vocabulary import words
from derail_ros.vocabulary.outcome import derailed

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from numpy.typing import NDArray

    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.vocabulary.events import Collision


@dataclass(frozen=True)
class Kind:
    """Defaults of a kind of film."""

    fps: int  # pictures per second of the film
    rate: float  # recorded time per time of the film
    width: int  # pixels


KINDS = {".mp4": Kind(20, 1.0, 960), ".gif": Kind(8, 2.0, 640)}
"""Kinds of films by their suffix. A GIF of half a minute stays below 2 MB."""
DPI = 100
MOST = 20_000
"""No film has more pictures than this."""
COLOURS = 48
"""Of a GIF."""
MARKED = 1.0
"""How long a collision stays marked, s of recorded time."""


class FilmError(ValueError):
    """A film cannot be made as asked."""


def kind_of(path: Path) -> Kind:
    """The kind of a film by its name.

    Raises
    ------
    FilmError
        If there is no such kind, or ffmpeg is missing for it.
    """
    suffix = path.suffix.lower()
    if suffix not in KINDS:
        raise FilmError(f"{path}: the name of a film must end in {' or '.join(KINDS)}")
    if suffix == ".mp4":
        _ffmpeg()
    return KINDS[suffix]


def _ffmpeg() -> str:
    """Path of ffmpeg."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        if found := shutil.which("ffmpeg"):
            return found
    raise FilmError("MP4 needs ffmpeg: pip install 'derail_ros[video]'; or choose a .gif")


def times(
    run: RecordedRun, fps: int, rate: float, start: float | None, end: float | None
) -> NDArray[np.float64]:
    """Moments of the pictures, s.

    Raises
    ------
    FilmError
        If there are none, or too many.
    """
    if not math.isfinite(rate) or rate <= 0.0:
        raise FilmError(f"rate: must be above zero, got {rate:g}")
    first, last = float(run.time[0]), float(run.time[-1])
    low = first if start is None else max(first, start)
    high = last if end is None else min(last, end)
    if not high > low:
        raise FilmError(f"no time to show: the recording runs from {first:g} s to {last:g} s")
    count = (high - low) / rate * fps
    if count > MOST:
        raise FilmError(f"{count:.0f} pictures are too many; raise --rate or lower --fps")
    return np.append(np.arange(low, high, rate / fps), high)


class Stage:
    """A figure whose cars are moved from picture to picture.

    Parameters
    ----------
    run : what is shown
    width : pixels

    Attributes
    ----------
    moving : what changes from picture to picture, from below to above; empty: everything
    """

    moving: Sequence[Artist] = ()
    _still: Any = None

    def __init__(self, run: RecordedRun, width: int) -> None:
        self.run = run
        scene = final_scene(run)
        window = drawing.stage(scene)
        aspect = float(np.clip((window[3] - window[2]) / (window[1] - window[0]), 0.3, 0.62))
        inches = 2 * round(width / 2) / DPI
        # Even numbers of pixels, which video wants.
        tall = 2 * round(width * aspect / 2) / DPI
        head = 2 * round(0.075 * width / 2) / DPI
        self.window = x0, x1, y0, y1 = drawing.fit(window, tall / inches)
        self.figure = drawing.sheet(inches, tall + head, dpi=DPI)
        scale = max(width / 960, min(0.75, width / 853))  # of texts, larger in small films
        points = inches * 72.0 / (x1 - x0)
        self.axes = axes = drawing.place(self.figure, 0.0, head, inches, tall)
        drawing.show(axes, self.window)
        drawing.draw_track(axes, scene, self.window, points)

        def put(left: float, top: float, text: str = "", **look: Any) -> Any:
            return drawing.put(self.figure, left * inches, top * head, text, **look)

        self.clock = put(0.012, 0.32, size=13 * scale, weight="bold", color=INK)
        self.facts = put(0.012, 0.76, size=9 * scale)
        title = min(10.0, 620.0 / max(len(run.title), 1)) * scale
        put(0.988, 0.32, run.title, size=title, ha="right", color=INK)
        self.figure.legend(
            handles=drawing.state_handles(),
            loc="center right",
            bbox_to_anchor=(0.988, 1.0 - 0.76 * head / (tall + head)),
            ncol=3,
            **(drawing.LEGEND | {"fontsize": 8.0 * scale, "handleheight": 0.7}),
        )
        self._orient(scene, scale)
        self.bodies = drawing.draw_bodies(axes, scene, 0.8)
        self.fronts = drawing.draw_fronts(axes, scene)
        # Never smaller than can be read: where there are too many, some are left out.
        size = max(float(np.clip(1.4 * points, 0.0, 9.0)) * scale, 7.5)
        self.room = (1.5 * size / points, 1.1 * size / points)
        outline = [withStroke(linewidth=2.0 * scale, foreground="white")]
        look = {"size": size, "weight": "bold", "ha": "center", "va": "center_baseline"}
        look |= {"zorder": 10, "clip_on": True, "path_effects": outline}
        self.numbers = [
            axes.text(0.0, 0.0, str(i + 1) if real else "", **look)
            for i, real in enumerate(run.cars.real)
        ]
        star: dict[str, Any] = {"ls": "", "marker": "*", "mfc": VERMILION, "mec": "white"}
        (self.stars,) = axes.plot([], [], ms=17 * scale, zorder=12, **star)
        look = {"size": 9.5 * scale, "weight": "bold", "color": VERMILION, "va": "bottom"}
        self.forces = [
            drawing.label(axes, "", (0.0, 0.0), (0, 9 * scale), zorder=13, **look)
            for _ in range(4)
        ]
        self.moving = (*self.bodies.artists, self.fronts, *self.numbers, self.stars, *self.forces,
                       self.clock, self.facts)  # fmt: skip

    def _orient(self, scene: Scene, scale: float) -> None:
        """The direction of travel at the upper edge, and the scale, clear of the final scene."""
        axes, window = self.axes, self.window
        x0, x1, _, y1 = window
        wide, point = x1 - x0, drawing.per_point(axes, window)
        text = 0.6 * 8.5 * scale * len(drawing.TRAVEL) * point
        half = 0.5 * np.array([text + 0.06 * wide, 22.0 * scale * point])
        level = y1 - 0.035 * wide
        taken = np.concatenate(
            [drawing.bodies_at(scene), drawing.break_labels(axes, scene, window)[1]]
        )
        edge = half[0] + 0.012 * wide
        places = [(x1 - edge, level), (x0 + edge, level), (0.5 * (x0 + x1), level)]
        middle = drawing.freest(places, half, taken)
        corner = np.array([middle[0] + half[0] - 0.028 * wide, level])
        drawing.draw_direction(axes, corner, scene.travel, 0.022 * wide, 1.4 * scale)
        look: dict[str, Any] = {"ha": "right", "size": 8.5 * scale}
        drawing.label(axes, drawing.TRAVEL, corner - [0.032 * wide, 0.0], **look)
        used = ("upper right", "upper left", "")[places.index(middle)]
        free = [c for c in drawing.FREE_CORNERS if c != used]
        drawing.scale_inside(axes, window, 0.15, scale, scene, free)

    def show(self, time: float) -> None:
        """Show a time (s)."""
        run = self.run
        scene = scene_at(run, time)
        x0, x1, _, _ = self.window
        self.bodies.move(scene)
        self.fronts.set_verts(list(scene.fronts()[scene.real]))
        shown: list[tuple[float, float]] = []
        for text, (x, y) in zip(self.numbers, scene.pose[:, :2]):
            inside = drawing.within(self.window, x, y) and bool(text.get_text())
            free = all(abs(x - a) > self.room[0] or abs(y - b) > self.room[1] for a, b in shown)
            text.set_visible(inside and free)
            text.set_position((x, y))
            if inside and free:
                shown.append((float(x), float(y)))
        recent = sorted(
            (
                c
                for c in run.collisions
                if c.peak_force >= NOTABLE and c.peak_time <= time < c.peak_time + MARKED
            ),
            key=lambda c: -c.peak_force,
        )
        told: list[Collision] = []
        for c in recent:  # of labels that would cover each other the larger force stays
            clear = all(
                abs(c.x - o.x) > 0.075 * (x1 - x0) or abs(c.y - o.y) > 0.025 * (x1 - x0)
                for o in told
            )
            if clear and len(told) < len(self.forces):
                told.append(c)
        self.stars.set_data([c.x for c in recent], [c.y for c in recent])
        for k, text in enumerate(self.forces):
            text.set_visible(k < len(told))
            if k < len(told):
                text.set_text(words.force(told[k].peak_force))
                text.xy = (told[k].x, told[k].y)
        self.clock.set_text(f"{time:.2f} s")
        line = derailed(int((scene.derailed & scene.real & scene.own).sum()))
        hardest = float(scene.peak_force.max(initial=0.0))
        if hardest > 0.0:
            line += f", largest force {words.force(hardest)}"
        self.facts.set_text(line)

    def picture(self, time: float) -> Image.Image:
        """The picture at a time (s). What does not move is drawn once."""
        self.show(time)
        canvas: Any = self.figure.canvas
        if self._still is None:
            for artist in self.moving:
                artist.set_animated(True)
            canvas.draw()
            self._still = canvas.copy_from_bbox(self.figure.bbox)
        elif self.moving:
            canvas.restore_region(self._still)
        else:
            canvas.draw()
        for artist in self.moving:
            self.figure.draw_artist(artist)
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def film(
    run: RecordedRun,
    path: Path,
    fps: int | None = None,
    rate: float | None = None,
    width: int | None = None,
    start: float | None = None,
    end: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    stage: type[Stage] = Stage,
) -> int:
    """Make a film; returns its number of pictures.

    Parameters
    ----------
    run, path : what is shown, and the file; its suffix is the kind of film
    fps, rate, width : see :class:`Kind`; by default those of :data:`KINDS`
    start, end : recorded time that is shown, s
    progress : called with the number of pictures that are done, and of all
    stage : what draws

    Raises
    ------
    FilmError
        If the kind of file or the time asked for cannot be, or the file cannot be written.
    """
    kind = kind_of(path)
    fps = kind.fps if fps is None else fps
    moments = times(run, fps, kind.rate if rate is None else rate, start, end)
    if path.is_dir():
        raise FilmError(f"{path}: must be a file, is a folder")
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        temporary.touch()  # before the work, not after it
    except OSError as error:
        raise FilmError(f"{path}: cannot be written: {error.strerror}") from None

    def counted() -> Iterator[float]:
        for k, moment in enumerate(moments.tolist()):
            progress(k, len(moments))
            yield moment
        progress(len(moments), len(moments))

    write = _gif if path.suffix.lower() == ".gif" else _mp4
    try:
        with matplotlib.rc_context(STYLE | {"path.simplify": True}):
            write(stage(run, width or kind.width), counted(), temporary, fps)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return len(moments)


def still(
    run: RecordedRun, path: Path, width: int | None, time: float, stage: type[Stage] = Stage
) -> None:
    """Write the picture of a time (s) as PNG; ``width`` in pixels."""
    with matplotlib.rc_context(STYLE | {"path.simplify": True}):
        stage(run, width or KINDS[".mp4"].width).picture(time).save(path)


def _mp4(stage: Stage, moments: Iterator[float], path: Path, fps: int) -> None:
    matplotlib.rcParams["animation.ffmpeg_path"] = _ffmpeg()
    logging.getLogger("matplotlib.animation").setLevel(logging.ERROR)  # it is said below
    writer = FFMpegWriter(fps=fps, codec="h264", extra_args=["-crf", "23"])
    try:
        with writer.saving(stage.figure, str(path), DPI):
            for moment in moments:
                stage.show(moment)
                writer.grab_frame()
    except subprocess.CalledProcessError as error:
        said = str(error.stderr or error).strip().splitlines()
        raise FilmError(f"ffmpeg: {said[-1]}") from None
    except OSError as error:
        raise FilmError(f"ffmpeg: {str(error).splitlines()[0]}") from None


def _gif(stage: Stage, moments: Iterator[float], path: Path, fps: int) -> None:
    # Pillow itself and not matplotlib's PillowWriter, which keeps all pictures in memory and
    # gives each its own colours: the film shimmers and is larger.
    peak = stage.run.outcome.peak_force_time
    palette = stage.picture(peak if math.isfinite(peak) else math.inf).quantize(COLOURS)
    pictures = (
        stage.picture(moment).quantize(palette=palette, dither=Image.Dither.NONE)
        for moment in moments
    )
    first = next(pictures)
    more = {"duration": round(1000 / fps), "loop": 0, "optimize": False}
    first.save(path, save_all=True, append_images=pictures, **more)
