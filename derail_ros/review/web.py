"""Pages of one file: a template with style, script, and a policy that allows only these.

Strings of runs reach a page escaped (:func:`script_json`), and its script sets them as text only.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterable
from importlib import resources
from typing import Any

import numpy as np

from derail_ros.recording.recorded_run import Cars, SampledLine
from derail_ros.vocabulary.site import Shape


def text(package: str, name: str) -> str:
    """A file of a page."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


def scene_script(script: str) -> str:
    """The script of a page that draws the scene (``scene.js``): both in one function."""
    scene = text("derail_ros.review", "scene.js")
    return f'"use strict";\n(() => {{\n{scene}\n{script}\n}})();\n'


def assemble(template: str, style: str, script: str, connect: str = "", **parts: str) -> str:
    """A page of a template, in which ``@NAME@`` stands for a part.

    Parameters
    ----------
    template, style, script : of the page
    connect : source from which the script may fetch, for example 'self'; "" for none
    parts : name -> HTML
    """
    policy = "; ".join(
        (
            "default-src 'none'",
            f"script-src '{_hash(script)}'",
            f"style-src '{_hash(style)}'",
            "img-src data:",
            *([f"connect-src {connect}"] if connect else []),
            "base-uri 'none'",
            "form-action 'none'",
        )
    )
    parts |= {"CSP": policy, "CSS": style, "JS": script}
    # One pass, so that what a run says is never taken for a place holder.
    pieces = template.split("@")
    return "".join(piece if k % 2 == 0 else parts[piece] for k, piece in enumerate(pieces))


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return "sha256-" + base64.b64encode(digest).decode("ascii")


def script_json(value: Any) -> str:
    """JSON that cannot end the script element that it stands in."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def car_data(cars: Cars) -> list[dict[str, Any]]:
    """Data of each car for the script."""
    return [
        {
            "name": cars.name[i],
            "kind": cars.kind[i],
            "contents": cars.contents[i],
            "mass": float(cars.mass[i]),
            "length": float(cars.length[i]),
            "width": float(cars.width[i]),
            "pivot": float(cars.pivot[i]),
            "coupler": [float(v) for v in cars.coupler[i]],
            "couplers": list(cars.coupler_kind[i]),
            "represents": int(cars.represents[i]),
            "cut": int(cars.cut[i]),
        }
        for i in range(len(cars))
    ]


def track_data(line: SampledLine, low: float, high: float) -> dict[str, Any]:
    """The centre line (of a straight one that from ``low`` to ``high``, m) and the breaks."""
    if line.straight:
        level = float(line.y[0]) if len(line.y) else 0.0
        x, y = [low, high], [level, level]
    else:
        from scipy.interpolate import CubicSpline  # slow to load

        # Finer than it was recorded, so that curves look like curves.
        s = np.linspace(line.s[0], line.s[-1], min(4000, 4 * len(line.s)))
        x, y = (CubicSpline(line.s, p)(s).round(3).tolist() for p in (line.x, line.y))
    breaks = [
        {"x": float(b[1]), "y": float(b[2]), "heading": float(b[3]), "time": float(b[4])}
        for b in line.breaks
    ]
    return {"x": x, "y": y, "breaks": breaks}


def place_data(shapes: Iterable[Shape]) -> list[dict[str, Any]]:
    """Data of the place for the script."""
    return [
        {
            "role": shape.role,
            "name": shape.name,
            "closed": shape.closed,
            "points": shape.points.round(3).tolist(),
        }
        for shape in shapes
    ]


def contact_data(c: Any) -> dict[str, Any]:
    """A ``vocabulary.events.Collision`` for the script."""
    return {
        "a": c.car_a,
        "b": c.car_b,
        "object": c.object,
        "start": round(c.start, 6),
        "end": None if math.isnan(c.end) else round(c.end, 6),
        "peak": round(c.peak_force, 1),
        "peakTime": round(c.peak_time, 6),
        "closing": round(c.closing_speed, 4) if math.isfinite(c.closing_speed) else 0.0,
        "x": round(c.x, 3),
        "y": round(c.y, 3),
        "angle": round(math.degrees(c.angle), 2) if math.isfinite(c.angle) else 0.0,
        "touch": c.touch,
    }
