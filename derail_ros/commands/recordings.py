"""Commands on recordings: review, export, compare, animate, play, repair, replay."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.commands.options import Bag, Json, Namespace, NewDir, Texts, WhichRun, written
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.recording.manifest import Manifest
    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.recording.run_messages import RunMessages


def read(path: str | Path, run: str | None = None, namespace: str | None = None) -> RecordedRun:
    """Read a recording; warnings about it go to stderr.

    Raises
    ------
    CommandFailure
        If it cannot be read.
    """
    from derail_ros.recording.reader import read_bag

    with bag_errors():
        found = read_bag(path, run, namespace)
    warn(found.warnings, found.path)
    return found


@contextmanager
def bag_errors() -> Iterator[None]:
    """Report an error of a recording or a disk in one line."""
    from derail_ros.recording.storage import BagError

    try:
        yield
    except BagError as error:
        raise CommandFailure(str(error)) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        raise CommandFailure(f"{place}{error.strerror or error}") from None


def warn(warnings: Iterable[str], path: Path) -> None:
    """Print warnings on a recording."""
    for warning in warnings:
        note(f"derail: warning: {path}: {warning}")


def review(
    bag: Bag,
    output: NewDir,
    run: WhichRun = None,
    namespace: Namespace = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replay: Annotated[bool, typer.Option(help="Write the replay page.")] = True,
    as_json: Json = False,
) -> int:
    """Summarize a recording: text, JSON, figures and a replay page."""
    from derail_ros.review import summary

    found = read(bag, run, namespace)
    output = common.output_directory(output)
    facts = summary.findings(found)
    with bag_errors():
        common.write_json(output / "summary.json", facts)
        text = summary.text(found, facts)
        (output / "summary.txt").write_text(text, encoding="utf-8")
        written = ["summary.txt", "summary.json"]
        if replay:
            from derail_ros.review import replay_page as page

            page.write(found, output / "replay.html", facts)
            written.append("replay.html")
        if figures:
            written += write_figures(found, output)
    if as_json:
        common.print_json("review", facts)
        return OK
    print(found.title)
    for sentence in summary.headline(found):
        print(sentence)
    print(f"in {output}: {', '.join(written)}")
    return OK


def write_figures(found: RecordedRun, output: Path) -> list[str]:
    """Draw the figures of a run and return their names."""
    from derail_ros.review import drawing, figures, plots
    from derail_ros.review.scene import final_scene

    paths = figures.save_outcome(final_scene(found), found.outcome, output)
    drawn = {
        f"collision_{k}": plots.collision(found, c)
        for k, c in enumerate(plots.main_collisions(found), 1)
    }
    drawn["speeds"] = plots.speeds(found)
    drawn["energy"] = plots.energy_over_time(found)
    drawn["space_time"] = plots.space_time(found)
    paths += [drawing.save(f, output / f"{name}.png") for name, f in drawn.items() if f]
    return [path.name for path in paths]


def export(
    bag: Bag,
    output: NewDir,
    form: Annotated[str, typer.Option("--format", help="Format: csv or parquet.")] = "csv",
    run: WhichRun = None,
    namespace: Namespace = None,
    geo: Annotated[
        bool, typer.Option("--geo", help="Write GeoJSON and KML of the scene, not tables.")
    ] = False,
    members: Annotated[
        int,
        typer.Option(
            min=0, help="With --geo: runs of its scenario, for the ground that cars may cover."
        ),
    ] = 0,
) -> int:
    """Write the histories of the cars in a recording as tables, or the scene as maps."""
    from derail_ros.review.histories import FORMATS, export

    if form not in FORMATS:
        raise CommandFailure(f"--format: must be {' or '.join(FORMATS)}, got {form!r}")
    if form == "parquet":
        common.need_extra("--format parquet", "studies", "pyarrow")
    if members and not geo:
        raise CommandFailure("--members: only goes with --geo")
    found = read(bag, run, namespace)
    output = common.output_directory(output)
    if geo:
        return _export_maps(found, output, members)
    with bag_errors():
        counts = export(found, output, form)
    for name, rows in counts.items():
        print(f"{output / name}  {rows} rows")
    return OK


def _export_maps(found: RecordedRun, output: Path, members: int) -> int:
    """Write the scene of a recording as GeoJSON and KML."""
    from derail_ros.review import maps

    footprints = []
    if members:
        import yaml

        from derail_ros.scenario import ScenarioError, loads_scenario
        from derail_ros.studies.ensemble import ensemble_jobs, run_many
        from derail_ros.studies.members import Members

        with common.refusing(ScenarioError, at=f"{found.path}: its scenario cannot be read"):
            scenario = loads_scenario(yaml.safe_dump(found.scenario), found.name)
        common.warm_up()
        kept = Members()
        for result in run_many(ensemble_jobs(scenario, members)):
            kept.add(result.job.member, result.outcome, result.job.params().cars)
        footprints = kept.footprints()
    with bag_errors():
        counts = maps.export(found, output, footprints)
    for name, features in counts.items():
        print(f"{output / name}  {count(features, 'feature')}")
    if "run.kml" not in counts:
        note("derail: the scenario has no site.datum: coordinates are metres, and there is no KML")
    return OK


def compare(
    first: Bag,
    second: Bag,
    output: Annotated[Path | None, written("Write text, JSON and both scenes there.")] = None,
    as_json: Json = False,
) -> int:
    """Compare two recordings: measures, scenes and events."""
    from derail_ros.review import comparison

    a, b = read(first), read(second)
    if output is not None:
        output = common.output_directory(output)
    facts = comparison.compare(a, b)
    text = comparison.text(facts)
    if output is not None:
        from derail_ros.review.drawing import save

        with bag_errors():
            common.write_json(output / "comparison.json", facts)
            (output / "comparison.txt").write_text(
                comparison.text(facts, most=1000), encoding="utf-8"
            )
            save(comparison.scenes(a, b), output / "scenes.png")
    if as_json:
        common.print_json("comparison", facts)
        return OK
    print(text, end="")
    if output is not None:
        print(f"\nin {output}: comparison.txt, comparison.json, scenes.png")
    return OK


def check_times(start: float | None, end: float | None, first: float, last: float) -> None:
    """Refuse a stretch of time that holds nothing of a recording from ``first`` to ``last``, s."""
    runs = f"the recording runs from {first:g} s to {last:g} s"
    if start is not None and not start < last:
        raise CommandFailure(f"--start: {start:g} s is not before its end: {runs}")
    if end is not None and not end > first:
        raise CommandFailure(f"--end: {end:g} s is not after its beginning: {runs}")
    if start is not None and end is not None and not start < end:
        raise CommandFailure(f"--end: {end:g} s is not after --start, {start:g} s")


def animate(
    bag: Bag,
    output: Annotated[Path, written("Film (.mp4, .gif) or still (.png) to write.", "FILE")],
    run: WhichRun = None,
    namespace: Namespace = None,
    fps: Annotated[
        int | None, typer.Option(min=1, max=60, help="Pictures per second [20; GIF: 8].")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Recorded time per time of the film [1; GIF: 2].")
    ] = None,
    width: Annotated[
        int | None, typer.Option(min=320, max=3840, help="Width, pixels [960; GIF: 640].")
    ] = None,
    start: Annotated[float | None, typer.Option(help="Begin at this time, s.")] = None,
    end: Annotated[float | None, typer.Option(help="End at this time, s.")] = None,
    view: Annotated[str, typer.Option(help="top, or 3d (needs MuJoCo and OpenGL).")] = "top",
) -> int:
    """Make a film of a recording, or a still of the time --end."""
    from derail_ros.review.film import FilmError, Stage, film, kind_of, still

    if view not in ("top", "3d"):
        raise CommandFailure(f"--view: must be top or 3d, got {view!r}")
    stage = Stage
    if view == "3d":
        from derail_ros.review.film3d import Stage3D

        stage = Stage3D
    with common.refusing(FilmError):
        picture = output.suffix.lower() == ".png"
        if not picture:
            kind_of(output)
        found = read(bag, run, namespace)
        last = float(found.time[-1])
        check_times(start, end, float(found.time[0]), last)
        with bag_errors():
            output.parent.mkdir(parents=True, exist_ok=True)
            if picture:
                still(found, output, width, last if end is None else end, stage)
                print(output)
                return OK
        with bag_errors(), common.progress(*common.counting_columns()) as bars:
            task = bars.add_task(output.name, total=None)

            def tell(done: int, total: int) -> None:
                bars.update(task, completed=done, total=total)

            count = film(found, output, fps, rate, width, start, end, tell, stage)
    print(f"{output}: {count} pictures, {output.stat().st_size / 1e6:.1f} MB")
    return OK


def view3d(
    bag: Bag,
    run: WhichRun = None,
    namespace: Namespace = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
) -> int:
    """Show a recording in three dimensions in the browser."""
    common.need_extra("view3d", "spatial", "viser")
    from derail_ros.review.view3d import View

    view = View(read(bag, run, namespace), port)
    print(f"{view.address}  (Ctrl-C ends it)", flush=True)
    try:
        view.run_for()
    except KeyboardInterrupt:
        pass
    finally:
        view.server.stop()
    return OK


def export_world(
    bag: Bag,
    output: Annotated[Path, written("File to write.", "FILE")],
    form: Annotated[str, typer.Option("--format", help="Format: mjcf, sdf or gltf.")] = "mjcf",
    at: Annotated[float | None, typer.Option(help="Time, s; default: the end.")] = None,
    run: WhichRun = None,
    namespace: Namespace = None,
) -> int:
    """Write the wreck as a world for other simulators."""
    from derail_ros.review.world import FORMATS, World, write

    if form not in FORMATS:
        raise CommandFailure(f"--format: must be {', '.join(FORMATS)}, got {form!r}")
    if form == "gltf":
        common.need_extra("--format gltf", "spatial", "trimesh")
    found = read(bag, run, namespace)
    last = float(found.time[-1])
    if at is not None and not float(found.time[0]) <= at <= last:
        raise CommandFailure(f"--at: must lie within {found.time[0]:g} and {last:g} s, got {at:g}")
    world = World.of(found, last if at is None else at)
    with bag_errors():
        write(world, form, output)
    free = int(world.free.sum())
    print(f"{output}: {count(len(world.bodies), 'car')}, {free} free, at {world.time:.2f} s")
    if found.model == PLANAR and free:
        note("derail: cars of a planar run may overlap; in the world they move apart")
    return OK


def play(
    bag: Bag,
    rate: Annotated[float, typer.Option(help="Recorded time per wall time.")] = 1.0,
    start: Annotated[float, typer.Option(help="Begin this long after the beginning, s.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for the service resume.")] = False,
    clock: Annotated[bool, typer.Option(help="Publish /clock.")] = True,
    topics: Annotated[
        Texts, typer.Option(help="A topic to play, or a pattern of names; may be repeated.")
    ] = None,
    exclude: Annotated[Texts, typer.Option(help="A topic not to play, in the same way.")] = None,
    remap: Annotated[
        Texts, typer.Option(metavar="FROM:=TO", help="Another name for a topic; may be repeated.")
    ] = None,
) -> int:
    """Publish a recording on a ROS 2 graph, with the node player."""
    from derail_ros.recording.storage import open_bag

    if not math.isfinite(rate) or rate <= 0.0:
        raise CommandFailure(f"--rate: must be above zero, got {rate:g}")
    if not math.isfinite(start) or start < 0.0:
        raise CommandFailure(f"--start: must be zero or above, got {start:g}")
    with bag_errors():
        found = open_bag(bag)
    if not found.intact:
        raise CommandFailure(f"{bag}: is cut off; repair it with `derail repair {bag}`")
    try:
        import rclpy  # noqa: F401
    except ImportError:
        raise CommandFailure(
            "play needs ROS 2 (rclpy); without it, `derail review` makes a page that plays",
            FAILED,
        ) from None
    from derail_ros.nodes.player import main

    parameters = {
        "rate": rate,
        "start_offset": start,
        "loop": loop,
        "start_paused": paused,
        "publish_clock": clock,
    }
    arguments = ["--ros-args", "-p", f"path:='{str(found.path).replace(chr(39), chr(39) * 2)}'"]
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(float(value))
        arguments += ["-p", f"{name}:={text}"]
    for name, names in (("topics", topics), ("exclude", exclude)):
        if names:
            arguments += ["-p", f"{name}:={json.dumps(list(names))}"]
    for rule in remap or ():
        if not all(rule.partition(":=")):
            raise CommandFailure(f"--remap: must be FROM:=TO, got {rule}")
        arguments += ["-r", rule]
    return main(arguments)


def repair(
    bag: Bag,
    output: Annotated[
        Path | None, written("New folder for the repaired recording; default: BAG_repaired.")
    ] = None,
) -> int:
    """Repair a recording whose recorder was killed."""
    from derail_ros.recording.repair import repair

    with bag_errors():
        done = repair(bag, output)
    warn(done.warnings, Path(bag))
    total = sum(done.counts.values())
    if done.was_whole:
        print(
            f"{done.path}: whole, with {count(total, 'message')}: "
            "nothing to repair, nothing written"
        )
        return OK
    print(
        f"{done.path}: {count(total, 'message')} on {count(len(done.counts), 'topic')},"
        f" {done.span[0] * 1e-9:.2f} s to {done.span[1] * 1e-9:.2f} s"
    )
    return OK


def replay(
    bag: Annotated[
        str, typer.Argument(help="A recording: its folder, a file of it, or its manifest.json.")
    ],
    as_json: Json = False,
) -> int:
    """Compute recorded runs again, with their commands, and compare them to the bit.

    The exit code is 3 if anything differs.
    """
    from derail_ros.recording.recomputation import engine_differs, recompute
    from derail_ros.scenario import ScenarioError
    from derail_ros.vocabulary.errors import ParameterError

    manifest, recorded = _found(Path(bag))
    other = engine_differs(manifest)
    if other:
        note("derail: computed by another version of the engine: the last bits may differ")
    common.warm_up()
    with common.refusing(ScenarioError, ParameterError, KeyError, TypeError, IndexError, at=bag):
        results = recompute(manifest, recorded)
    same = not any(result.differences for result in results)
    if as_json:
        common.print_json(
            "replay",
            {
                "same": same,
                "same_engine": not other,
                "runs": [result.plain() for result in results],
            },
        )
    else:
        for result in results:
            print(_recomputed(result))
            for difference in result.differences:
                print(f"  {difference}")
    return OK if same else FAILED


def _found(path: Path) -> tuple[Manifest, dict[str, RunMessages] | None]:
    """Manifest and messages at a place: a recording as all commands take it, or a manifest.

    Of a recording without the file its messages tell scenario and commands.
    """
    from derail_ros.recording.decoding import check_version
    from derail_ros.recording.manifest import FILE_NAME
    from derail_ros.recording.recomputation import collect
    from derail_ros.recording.storage import BagError, NotABagError, open_bag

    if path.suffix == ".json":
        manifest = _manifest(path)
        try:
            return manifest, collect(open_bag(path.parent)).runs
        except BagError:
            return manifest, None
    try:
        raw = open_bag(path)
    except NotABagError as error:
        if (path / FILE_NAME).is_file():
            return _manifest(path / FILE_NAME), None
        raise CommandFailure(str(error)) from None
    except BagError as error:
        raise CommandFailure(str(error)) from None
    with bag_errors():
        check_version(raw)
        found = collect(raw)
    beside = raw.path / FILE_NAME  # one beside a file alone may be that of another
    if raw.path.is_dir() and beside.is_file():
        manifest = _manifest(beside)
    else:
        manifest = found.manifest()
        if manifest.settings.get("gathered"):
            note(
                f"derail: {raw.path}: no manifest: taking scenario and commands from the messages"
            )
    if not manifest.runs:
        raise CommandFailure(
            f"{raw.path}: contains no train (topic consist), so no run can be computed again"
        )
    return manifest, found.runs


def _manifest(path: Path) -> Manifest:
    from derail_ros.recording.manifest import Manifest

    wrong = (ValueError, TypeError, KeyError, AttributeError)
    with (
        common.refusing(OSError, at=path),
        common.refusing(*wrong, at=f"{path}: not the manifest of a recording"),
    ):
        return Manifest.from_json(path.read_text(encoding="utf-8"))


def _recomputed(result: Any) -> str:
    text = (
        f"{result.run_id[:8]} {result.scenario}: {count(result.commands, 'command')}, "
        f"{count(result.steps, 'step')}, {result.time:.3f} s, {result.status}: "
    )
    if result.differences:
        return text + "differs"
    proofs = []
    if result.same_state:
        proofs.append("the final state")
    if result.events is not None:
        proofs.append(f"{count(result.events, 'event')} and {count(result.contacts, 'contact')}")
    if not proofs:
        return text + "computed again; nothing was recorded to compare with"
    return text + " and ".join(proofs) + " are the same to the bit"
