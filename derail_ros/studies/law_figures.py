"""Figures of the laws, as the source shows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine.laws.brake import cast_iron_factor, composition_factor
from derail_ros.engine.laws.contact import GAP_LAWS, INSIDE, gap_force, speed_factor
from derail_ros.engine.laws.ground import resistance
from derail_ros.engine.laws.knuckle import POLYNOMIALS, knuckle_moment, polynomial_root
from derail_ros.engine.laws.striker import spring_force
from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    INK,
    dress,
    grid_of,
    heading,
    label,
    sheet,
    styled,
)
from derail_ros.studies.drawing import SERIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from derail_ros.vocabulary.params import CouplerType, TrainParams

F64 = NDArray[np.float64]

CLOSING = (-4.0, -2.0, 0.0, 2.0, 5.0, 10.0)
"""Closing speeds of the curves of the collision force, m/s."""


def _over(law: Callable[..., float], x: F64, *constants: Any) -> F64:
    return np.array([law(float(u), *constants) for u in x])


def _look(k: int) -> dict[str, Any]:
    colour, _, dashes = SERIES[k % len(SERIES)]
    return {"color": colour, "ls": dashes, "lw": 1.6}


@styled
def laws(params: TrainParams, couplers: Mapping[str, CouplerType]) -> Figure:
    """Draw the laws with the constants of a run, and the strikers of coupler types by name."""
    figure = sheet(13.2, 8.3)
    panels = grid_of(figure, 6, 3, (0.75, 0.25, 1.05, 0.6, 0.85, 0.95))
    _brakes(panels[0], params)
    _strikers(panels[1], couplers)
    _knuckles(panels[2], params)
    _ground(panels[3], params)
    _gap(panels[4], params)
    _collision(panels[5], params)
    for axes, title in zip(
        panels,
        ("Brake force of a car", "Strikers", "Moment between coupler heads", "Ground reaction",
         "Gap law", "Collision force at a corner"),
        strict=True,
    ):  # fmt: skip
        axes.set_title(title, loc="left", size=10.5, weight="bold", pad=8)
        dress(axes)
    c = params.contact
    heading(
        figure,
        "Laws of the model",
        f"Constants of the run: F0 {params.brakes.force / 1e3:g} kN, F_max {c.force_max / 1e6:g} "
        f"MN, d_c {c.half_distance:g} m, d_b {c.buffer:g} m, gap law {c.gap_law}, inside "
        f"{c.inside}.",
        left=0.75,
    )
    return figure


def _brakes(axes: Axes, params: TrainParams) -> None:
    v = np.linspace(0.0, 30.0, 301)
    force = params.brakes.force / 1e3
    shoes = (("composition", composition_factor), ("cast iron", cast_iron_factor))
    for k, (name, law) in enumerate(shoes):
        axes.plot(3.6 * v, force * _over(law, v), label=name, **_look(k))
    axes.set_xlim(0.0, 108.0)
    axes.set_ylim(0.0)
    axes.set_xlabel("speed, km/h")
    axes.set_ylabel("full application, kN")
    axes.legend(frameon=False)


def _strikers(axes: Axes, couplers: Mapping[str, CouplerType]) -> None:
    x = np.linspace(0.0, 0.45, 901)
    for k, (name, c) in enumerate(couplers.items()):
        force = _over(spring_force, x, 0.0, c.striker_opening, c.k1, c.k2) / 1e6
        axes.plot(x, force, label=name, **_look(k))
    axes.set_xlim(0.0, 0.45)
    axes.set_ylim(0.0, 3.5)
    axes.set_xlabel("displacement at the striker, m")
    axes.set_ylabel("force, MN")
    axes.legend(frameon=False, ncol=2, loc="lower right", fontsize=8)


def _knuckles(axes: Axes, params: TrainParams) -> None:
    d = params.derailment
    limits = {"EE": d.knuckle_limit_ee, "FF": d.knuckle_limit_ff, "EF": d.knuckle_limit_ef}
    for k, (pair, limit) in enumerate(limits.items()):
        n = np.linspace(0.0, limit, 301)
        root = polynomial_root(pair)
        moment = -_over(knuckle_moment, n, *POLYNOMIALS[pair], root) / 1e3
        axes.plot(n, moment, label=f"{pair[0]}-{pair[1]}, parts at {limit:.2f} rad", **_look(k))
        axes.plot(limit, moment[-1], "x", color=_look(k)["color"], ms=7, mew=1.8)
    axes.set_xlim(0.0)
    axes.set_xlabel("angle between the couplers, rad")
    axes.set_ylabel("moment, kN m")
    axes.legend(frameon=False, loc="upper left", fontsize=8)


def _ground(axes: Axes, params: TrainParams) -> None:
    g = params.ground
    v = np.concatenate([np.linspace(0.0, 0.2, 200), np.linspace(0.2, 30.0, 200)])
    axes.plot(v, g.scale * _over(resistance, v, g.c_s, g.c_d, g.eps, g.c_v), **_look(0))
    axes.set_xlim(0.0, 30.0)
    axes.set_ylim(0.0)
    axes.set_xlabel("speed over the ground, m/s")
    axes.set_ylabel("force over load, 1")
    inset = axes.inset_axes((0.52, 0.14, 0.44, 0.36))
    slow = v <= 0.1
    inset.plot(
        v[slow], g.scale * _over(resistance, v[slow], g.c_s, g.c_d, g.eps, g.c_v), color=BLUE
    )
    inset.set_xlim(0.0, 0.1)
    dress(inset)
    inset.tick_params(labelsize=7.5)


def _gap(axes: Axes, params: TrainParams) -> None:
    c = params.contact
    x = np.linspace(-4.0 * c.half_distance, 6.0 * c.half_distance, 801)
    for k, (name, number) in enumerate(GAP_LAWS.items()):
        width = 2.2 if name == c.gap_law else 1.0
        force = _over(gap_force, x, 1.0, c.half_distance, c.buffer, number, INSIDE["even"])
        axes.plot(x, force * c.force_max / 1e6, label=name, **(_look(k) | {"lw": width}))
    held = np.where(x <= 0.0, c.force_max / 1e6, np.nan)
    axes.plot(
        x, held, color=INK, lw=2.2 if c.inside == "held" else 1.0, ls=(0, (1, 1)), label="held"
    )
    axes.axvline(0.0, color=FAINT, lw=0.8)
    axes.plot(c.half_distance, 0.5 * c.force_max / 1e6, "o", color=INK, ms=4, zorder=5)
    label(axes, "d_c", (c.half_distance, 0.5 * c.force_max / 1e6), (12, 2))
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(0.0, 1.15 * c.force_max / 1e6)
    axes.set_xlabel("gap, m (negative: inside)")
    axes.set_ylabel("force at no closing speed, MN")
    axes.legend(frameon=False, loc="upper right", fontsize=8)


def _collision(axes: Axes, params: TrainParams) -> None:
    c = params.contact
    x = np.linspace(-4.0 * c.half_distance, 4.0 * c.half_distance, 401)
    number, even = GAP_LAWS[c.gap_law], INSIDE[c.inside]
    bell = _over(gap_force, x, c.force_max, c.half_distance, c.buffer, number, even) / 1e6
    for k, v in enumerate(CLOSING):
        factor = speed_factor(v, c.c1, c.c2, c.c3)
        axes.plot(x, factor * bell, label=f"{v:+g} m/s" if v else "0", **_look(k))
    axes.axvline(0.0, color=FAINT, lw=0.8)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(0.0)
    axes.set_xlabel("gap, m (negative: inside)")
    axes.set_ylabel("force, MN")
    axes.legend(frameon=False, title="closing speed", loc="upper right", fontsize=8)
