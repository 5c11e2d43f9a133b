"""A film of a run, seen from above: MP4 with imageio-ffmpeg, GIF with Pillow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from derail_ros.review import figures, words
from derail_ros.review.figures import INK, STATES, STYLE, VERMILION
from derail_ros.review.replay_page import site
from derail_ros.review.run_scene import scene_at
from derail_ros.vocabulary.events import Collision

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.recording.recorded_run import RecordedRun

KINDS = (".mp4", ".gif")
DPI = 100
MOST = 20_000
"""No film has more pictures than this."""
MARKED = 1.0
"""How long a collision stays marked, s of recorded time."""


class FilmError(ValueError):
    """A film cannot be made as asked."""


def times(
    run: RecordedRun, fps: int, rate: float, start: float | None, end: float | None
) -> NDArray[np.float64]:
    """Moments of the pictures, s.

    Raises
    ------
    FilmError
        If there is none of them, or far too many.
    """
    if not math.isfinite(rate) or rate <= 0.0:
        raise FilmError(f"rate: must be above zero, not {rate:g}")
    first, last = float(run.time[0]), float(run.time[-1])
    low = first if start is None else max(first, start)
    high = last if end is None else min(last, end)
    if not high > low:
        raise FilmError(f"no time to show: the recording runs from {first:g} s to {last:g} s")
    count = (high - low) / rate * fps
    if count > MOST:
        raise FilmError(f"{count:.0f} pictures are too many: a higher rate or fewer a second")
    return np.append(np.arange(low, high, rate / fps), high)


class _Stage:
    """A figure whose cars are moved from picture to picture."""

    def __init__(self, run: RecordedRun, width: int) -> None:
        self.run = run
        window = tuple(site(run))
        aspect = float(np.clip((window[3] - window[2]) / (window[1] - window[0]), 0.3, 0.62))
        inches = width / DPI
        # Even numbers of pixels, which video wants.
        tall = 2 * round(width * aspect / 2) / DPI
        head = 2 * round(0.075 * width / 2) / DPI
        self.window = figures._fit(window, tall / inches)  # type: ignore[arg-type]
        self.figure = Figure(figsize=(inches, tall + head), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        scale = width / 960
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, tall / (tall + head)))
        figures._prepare(self.axes, self.window)
        points = inches * 72.0 / (self.window[1] - self.window[0])
        scene = scene_at(run, float(run.time[-1]))
        figures._draw_track(self.axes, scene, self.window, points)
        share = head / (tall + head)
        self.clock = self.figure.text(
            0.012, 1.0 - 0.32 * share, "", size=13 * scale, weight="bold", va="center"
        )
        self.facts = self.figure.text(
            0.012, 1.0 - 0.76 * share, "", size=9 * scale, color="#555555", va="center"
        )
        self.figure.text(
            0.988,
            1.0 - 0.32 * share,
            run.title,
            size=min(10.0, 620.0 / max(len(run.title), 1)) * scale,
            ha="right",
            va="center",
        )
        self._scale_bar(scale)
        self._key(1.0 - 0.76 * share, scale)
        self._travel(scene.travel, scale)
        self.bodies = [
            self.axes.add_collection(
                PolyCollection(
                    [], facecolors=fill, edgecolors=INK, lw=0.8, hatch=hatch or None, zorder=4
                )
            )
            for _, fill, hatch in STATES
        ]
        self.noses = self.axes.add_collection(PolyCollection([], facecolors=INK, zorder=4.5))
        # Never smaller than can be read: where there are too many, some are left out.
        size = max(float(np.clip(1.4 * points, 0.0, 9.0)), 7.5) * scale
        self.room = (1.5 * size / points, 1.1 * size / points)
        self.numbers = [
            self.axes.text(
                0.0,
                0.0,
                str(i + 1) if run.cars.represents[i] == 1 else "",
                size=size,
                weight="bold",
                ha="center",
                va="center_baseline",
                zorder=10,
                clip_on=True,
                path_effects=[withStroke(linewidth=2.0 * scale, foreground="white")],
            )
            for i in range(run.n)
        ]
        (self.stars,) = self.axes.plot(
            [], [], ls="", marker="*", ms=17 * scale, mfc=VERMILION, mec="white", zorder=12
        )
        self.forces = [
            self.axes.text(
                0.0,
                0.0,
                "",
                size=9.5 * scale,
                weight="bold",
                color=VERMILION,
                ha="center",
                va="bottom",
                zorder=13,
                bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
                clip_on=True,
            )
            for _ in range(4)
        ]

    def _key(self, level: float, scale: float) -> None:
        """What colours and hatches say."""
        self.figure.legend(
            handles=[
                Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.8, label=label)
                for label, fill, hatch in STATES
            ],
            loc="center right",
            bbox_to_anchor=(0.988, level),
            bbox_transform=self.figure.transFigure,
            ncol=len(STATES),
            frameon=False,
            fontsize=8.0 * scale,
            handlelength=1.8,
            columnspacing=1.2,
            borderaxespad=0.0,
            borderpad=0.0,
        )

    def _travel(self, travel: tuple[float, float], scale: float) -> None:
        """The direction of travel, in the corner over the scale bar's."""
        wide = self.window[1] - self.window[0]
        place = (self.window[1] - 0.04 * wide, self.window[3] - 0.035 * wide)
        figures._draw_arrow(self.axes, place, travel, 0.022 * wide, 1.4 * scale)
        self.axes.text(
            place[0] - 0.032 * wide,
            place[1],
            figures.TRAVEL,
            size=8.5 * scale,
            ha="right",
            va="center",
            zorder=13,
            bbox={"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
        )

    def _scale_bar(self, scale: float) -> None:
        wide = self.window[1] - self.window[0]
        bar = figures._nice(0.15 * wide)
        x, y = self.window[1] - 0.02 * wide, self.window[2] + 0.025 * wide
        self.axes.add_line(
            Line2D([x - bar, x], [y, y], color=INK, lw=2.5 * scale, solid_capstyle="butt")
        )
        self.axes.text(
            x - 0.5 * bar,
            y + 0.006 * wide,
            f"{bar:g} m",
            ha="center",
            va="bottom",
            size=8.5 * scale,
        )

    def picture(self, time: float) -> NDArray[np.uint8]:
        """(H, W, 3) the picture at a time."""
        run = self.run
        scene = run.scene(time)
        corners = scene.outlines()
        state = figures._state(scene)
        real = run.cars.real
        for k, body in enumerate(self.bodies):
            body.set_verts(list(corners[(state == k) & real]))
        nose = corners.copy()
        share = np.minimum(0.7 / run.cars.length, 0.5)[:, None]
        nose[:, 3] = corners[:, 0] + share * (corners[:, 3] - corners[:, 0])
        nose[:, 2] = corners[:, 1] + share * (corners[:, 2] - corners[:, 1])
        self.noses.set_verts(list(nose[real]))
        x0, x1, y0, y1 = self.window
        shown: list[tuple[float, float]] = []
        for text, (x, y) in zip(self.numbers, scene.pose[:, :2]):
            inside = bool(x0 < x < x1 and y0 < y < y1 and text.get_text())
            free = all(abs(x - a) > self.room[0] or abs(y - b) > self.room[1] for a, b in shown)
            text.set_visible(inside and free)
            text.set_position((x, y))
            if inside and free:
                shown.append((float(x), float(y)))
        recent = sorted(
            (
                c
                for c in run.collisions
                if c.peak_force >= 1e6 and c.peak_time <= time < c.peak_time + MARKED
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
        lift = 0.018 * (x1 - x0)
        for k, text in enumerate(self.forces):
            text.set_visible(k < len(told))
            if k < len(told):
                text.set_text(words.force(told[k].peak_force))
                text.set_position((told[k].x, told[k].y + lift))
        self.clock.set_text(f"{time:.2f} s")
        hardest = float(scene.peak_force.max(initial=0.0))
        line = words.derailed(int((scene.derailed & real).sum()))
        if hardest > 0.0:
            line += f", largest force {words.force(hardest)}"
        self.facts.set_text(line)
        canvas: Any = self.figure.canvas
        canvas.draw()
        return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def pictures(
    run: RecordedRun, moments: NDArray[np.float64], width: int
) -> Iterator[NDArray[np.uint8]]:
    """The pictures of a film."""
    with matplotlib.rc_context(STYLE | {"path.simplify": True}):
        stage = _Stage(run, 2 * round(width / 2))
        for moment in moments:
            yield stage.picture(float(moment))


def film(
    run: RecordedRun,
    path: Path,
    fps: int = 20,
    rate: float = 1.0,
    width: int = 960,
    start: float | None = None,
    end: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Make a film; returns its number of pictures.

    Raises
    ------
    FilmError
        If the kind of file or the time asked for cannot be, or the file cannot be written.
    ImportError
        If imageio-ffmpeg, which MP4 needs, is not installed.
    """
    if path.suffix.lower() not in KINDS:
        raise FilmError(f"{path}: a film ends in {' or '.join(KINDS)}")
    moments = times(run, fps, rate, start, end)

    def counted() -> Iterator[NDArray[np.uint8]]:
        for k, picture in enumerate(pictures(run, moments, width), 1):
            yield picture
            progress(k, len(moments))

    if path.is_dir():
        raise FilmError(f"{path}: is a folder")
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        temporary.touch()  # before the work, not after it
    except OSError as error:
        raise FilmError(f"{path}: cannot be written: {error.strerror}") from None
    progress(0, len(moments))
    try:
        (_mp4 if path.suffix.lower() == ".mp4" else _gif)(counted(), temporary, fps)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return len(moments)


def _mp4(frames: Iterator[NDArray[np.uint8]], path: Path, fps: int) -> None:
    import imageio_ffmpeg

    writer: Any = None
    try:
        for frame in frames:
            if writer is None:
                size = (frame.shape[1], frame.shape[0])
                writer = imageio_ffmpeg.write_frames(
                    str(path), size, fps=fps, macro_block_size=2, quality=7
                )
                writer.send(None)
            writer.send(frame)
    except OSError as error:  # with all that ffmpeg has to say, on many lines
        raise FilmError(f"{path}: ffmpeg: {str(error).splitlines()[0]}") from None
    finally:
        if writer is not None:
            writer.close()


def _gif(frames: Iterator[NDArray[np.uint8]], path: Path, fps: int) -> None:
    from PIL import Image

    first = Image.fromarray(next(frames))
    # One palette for all pictures, from one that has all colours, keeps the film from shimmering.
    palette = first.quantize(64, dither=Image.Dither.NONE)
    rest = (Image.fromarray(frame).quantize(64, dither=Image.Dither.NONE) for frame in frames)
    palette.save(
        path,
        save_all=True,
        append_images=rest,
        duration=round(1000 / fps),
        loop=0,
        optimize=False,
    )
