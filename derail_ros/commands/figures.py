"""``derail figures``: the figures of the source, drawn from this model."""

from __future__ import annotations

from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure
from derail_ros.commands.options import Jobs, NewDir, Settings, runs

KINDS = {
    "laws": "each law, with the constants of a scenario",
    "scene": "a scenario at the times given by --at",
    "variations": "six variations of the base train, with the published values",
    "scenes": "final scenes of all published runs",
}
"""What can be drawn."""


def run(
    kind: Annotated[str, typer.Argument(help=f"{', '.join(KINDS)}.")],
    output: NewDir,
    scenario: Annotated[
        str, typer.Argument(help="Scenario of laws and scene.")
    ] = "mississauga_published",
    settings: Settings = None,
    times: Annotated[
        list[float] | None, typer.Option("--at", help="Time of a scene, s (repeat for more).")
    ] = None,
    members: Annotated[int, runs("Runs a point of the variations.", 1)] = 10,
    jobs: Jobs = None,
) -> int:
    """Draw the source's figures from this model: laws, scenes, variations."""
    from derail_ros.review.drawing import save
    from derail_ros.studies import published_figures as f
    from derail_ros.studies.published import load_published

    if kind not in KINDS:
        raise CommandFailure(f"figures: must be one of {', '.join(KINDS)}, got {kind!r}")
    times = times or []
    if kind == "scene" and not times:
        raise CommandFailure("figures scene: give a time, e.g. --at 5.7")
    if times and min(times) < 0.0:
        raise CommandFailure(f"--at must be zero or more, got {min(times):g}")
    chosen = common.load(scenario, settings)
    folder = common.output_directory(output)
    drawn = {}
    if kind == "laws":
        from derail_ros.studies.law_figures import laws

        drawn["laws.png"] = laws(chosen.to_params(), chosen.coupler_types())
    elif kind == "scene":
        from derail_ros.review.figures import final_scene

        common.warm_up()
        for time, scene in f.scenes_at(chosen, times):
            drawn[f"scene_{time:.2f}s.png"] = final_scene(scene)
    else:
        with common.counting_runs(f"figures {kind}") as progress:
            if kind == "variations":
                found = f.variation_ensembles(members, jobs=jobs, progress=progress)
                drawn["variations.png"] = f.variations(found)
            else:
                cases = load_published().cases
                scenes = f.final_scenes(cases, jobs=jobs, progress=progress)
                drawn["scenes.png"] = f.scene_sheet(scenes)
    for name, figure in drawn.items():
        print(save(figure, folder / name, dpi=110))
    return OK
