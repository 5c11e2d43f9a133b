"""Compiled kernels never outlive the source they came from."""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

import derail_ros
from derail_ros.engine import jit

PACKAGE = Path(derail_ros.__file__).parent
ENGINE = PACKAGE / "engine"


@pytest.fixture
def tree(tmp_path):
    """A copy of the package's sources, which may be edited."""
    target = tmp_path / "tree"
    shutil.copytree(
        PACKAGE, target / "derail_ros", ignore=shutil.ignore_patterns("__pycache__", "*.pyc")
    )
    return target


def python(tree, code, cache=None, timeout=250):
    """Run code on the copy, in another process; its output."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    if cache is not None:
        environment["DERAIL_CACHE_DIR"] = str(cache)
    prefix = f"import sys; sys.path.insert(0, {str(tree)!r})\n"
    done = subprocess.run(
        [sys.executable, "-c", prefix + code],
        env=environment, capture_output=True, text=True, timeout=timeout, cwd=tree,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


HASH = """
import derail_ros.engine.jit as jit
print(jit.kernels_hash(), jit.CACHE_DIR, jit.__file__)
"""


def edit(tree, name, old, new):
    """Change a source file of the copy."""
    path = tree / "derail_ros" / "engine" / name
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_the_hash_follows_every_source_file(tree, tmp_path):
    cache = tmp_path / "cache"
    first, folder, file = python(tree, HASH, cache)
    assert Path(file).is_relative_to(tree)
    # where the sources lie does not matter, what they say does
    assert first == jit.kernels_hash()
    assert Path(folder).is_relative_to(cache)
    assert first in folder
    seen = {first}
    files = sorted((tree / "derail_ros" / "engine").rglob("*.py"))
    assert len(files) > 20
    # one process looks at all the edits: each changes the hash, and undone gives it back
    code = f"""
from pathlib import Path
import derail_ros.engine.jit as jit
for path in {[str(f) for f in files]!r}:
    path = Path(path)
    text = path.read_bytes()
    path.write_bytes(text + b"# edited\\n")
    print(jit.kernels_hash())
    path.write_bytes(text)
print(jit.kernels_hash())
"""
    *edited, last = python(tree, code, cache)
    assert last == first
    assert len({*edited, first}) == len(files) + 1
    # a new file, and a renamed one
    laws = tree / "derail_ros" / "engine" / "laws"
    (laws / "magnet.py").write_text("")
    seen.add(python(tree, HASH, cache)[0])
    (laws / "magnet.py").unlink()
    (laws / "ground.py").rename(laws / "soil.py")
    seen.add(python(tree, HASH, cache)[0])
    assert len(seen) == 3


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A folder that cannot be made, for root neither, and a place for temporary files."""
    (tmp_path / "file").touch()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "file" / "kernels-x"


def test_kernels_are_kept_in_a_private_folder_if_need_be(nowhere, tmp_path):
    folder, can_keep = jit._choose(nowhere)
    assert can_keep
    assert folder == tmp_path / "tmp" / f"derail_ros-{os.getuid()}" / "kernels-x"
    assert folder.is_dir()
    assert folder.parent.stat().st_mode & 0o077 == 0
    assert jit._choose(nowhere) == (folder, True)
    assert jit._choose(tmp_path / "kernels-x") == (tmp_path / "kernels-x", True)


@pytest.mark.parametrize("how", ["open to all", "a link", "a file", "no place at all"])
def test_kernels_are_not_kept_where_others_may_write(nowhere, tmp_path, monkeypatch, how):
    spare = tmp_path / "tmp" / f"derail_ros-{os.getuid()}"
    if how == "open to all":
        spare.mkdir()
        spare.chmod(0o777)
    elif how == "a link":
        (tmp_path / "elsewhere").mkdir()
        spare.symlink_to(tmp_path / "elsewhere")
    elif how == "a file":
        spare.touch()
    else:
        monkeypatch.setattr(tempfile, "tempdir", str(nowhere))
    assert jit._choose(nowhere) == (nowhere, False)


@pytest.mark.skipif(sys.platform == "win32", reason="no file locks there")
def test_one_process_at_a_time_writes_the_cache(tmp_path, monkeypatch):
    import fcntl

    monkeypatch.setattr(jit, "CACHE_DIR", tmp_path)
    monkeypatch.setattr(jit, "CAN_KEEP", True)
    saved = []
    kernel = jit.jit(lambda x: x + 1.0)
    # `save_overload` is ours, around numba's
    monkeypatch.setattr(type(kernel._cache), "_save_overload", lambda self, *a: saved.append(a))
    with open(tmp_path / "saving", "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        thread = threading.Thread(target=kernel._cache.save_overload, args=(1, 2))
        thread.start()
        thread.join(0.2)
        assert thread.is_alive() and not saved
    thread.join(30)
    assert saved == [(1, 2)]


def test_a_full_disk_stops_no_run(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "CACHE_DIR", tmp_path)
    monkeypatch.setattr(jit, "CAN_KEEP", True)
    kernel = jit.jit(lambda x: x + 1.0)

    def full(self, *_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(kernel._cache), "_save_overload", full)
    assert kernel(1.0) == 2.0


def test_two_versions_have_two_folders(tree, tmp_path):
    cache = tmp_path / "cache"
    one = python(tree, HASH, cache)[1]
    edit(tree, "laws/ground.py", "c_d + c_v * v", "c_d + 2.0 * c_v * v")
    two = python(tree, HASH, cache)[1]
    assert one != two


def test_an_edited_law_is_used_at_once(tree, tmp_path):
    # cheap: one law alone, compiled, cached, edited
    code = """
from derail_ros.engine.laws.ground import drag
print(20.0 * drag(20.0, 0.8, 0.7, 0.01, 0.03))
"""
    cache = tmp_path / "cache"
    # `drag` lives in the same file as what it calls; the trap is a caller in another file
    (tree / "derail_ros" / "engine" / "caller.py").write_text(
        "from derail_ros.engine.jit import jit\n"
        "from derail_ros.engine.laws.ground import resistance\n"
        "@jit\n"
        "def twice(v):\n"
        "    return 2.0 * resistance(v, 0.8, 0.7, 0.01, 0.03)\n"
    )
    code += "from derail_ros.engine.caller import twice\nprint(twice(20.0))\n"
    before = [float(x) for x in python(tree, code, cache)]
    again = [float(x) for x in python(tree, code, cache)]
    assert before == again == pytest.approx([1.3, 2.6], rel=1e-6)
    edit(tree, "laws/ground.py", "c_d + c_v * v", "c_d + 2.0 * c_v * v")
    after = [float(x) for x in python(tree, code, cache)]
    assert after == pytest.approx([1.9, 3.8], rel=1e-6)


RUN = """
from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.params import *
coupler = CouplerType("F73", "F", 1.524, 1.220, 0.300, 4.88e6)
car = Car(68e3, 1.165e6, 14.1, 2.6, 6.65, 5.75, coupler, coupler)
run = PlanarSimulation(TrainParams(
    cars=(car, car),
    initiation=InitiationParams(speed=10.0),
    brakes=BrakeParams(triggers=()),
))
run.advance_to(0.5)
print(repr(float(run.sample(0.5).v[0, 0])), run.state_hash())
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_an_edited_law_changes_the_run(tree, tmp_path):
    cache = tmp_path / "cache"
    first = python(tree, RUN, cache, timeout=900)
    assert python(tree, RUN, cache, timeout=900) == first
    edit(tree, "laws/ground.py", "c_d + c_v * v", "c_d + 2.0 * c_v * v")
    second = python(tree, RUN, cache, timeout=900)
    # more drag, a slower car
    assert float(second[0]) < float(first[0]) - 0.1
    assert second[1] != first[1]
    # the old source finds its own kernels again
    edit(tree, "laws/ground.py", "c_d + 2.0 * c_v * v", "c_d + c_v * v")
    assert python(tree, RUN, cache, timeout=900) == first


def test_equal_sources_share_their_kernels_wherever_they_are(tmp_path):
    """The content of a file decides where a kernel is found, neither its path nor its time."""

    def place(name, text):
        path = tmp_path / name / "law.py"
        path.parent.mkdir()
        path.write_text(text)
        os.utime(path, (1e9 + len(name), 1e9))
        scope = {"__name__": "some.law"}
        exec(compile(text, path, "exec"), scope)
        found = jit._Locator.from_function(scope["force"], str(path))
        return found.get_cache_path(), found.get_disambiguator(), found.get_source_stamp()

    law = "def force(x):\n    return 2.0 * x\n"
    here = place("here", law)
    assert place("elsewhere", law) == here
    edited = place("edited", law.replace("2.0", "3.0"))
    assert edited[:2] == here[:2] and edited[2] != here[2]
    assert jit._Locator.from_function(place, str(tmp_path / "nowhere.py")) is None


def test_another_processor_has_other_kernels_of_the_same_sources(monkeypatch):
    sources, kernels = jit.source_hash(), jit.kernels_hash()
    monkeypatch.setattr(jit.llvmlite.binding, "get_host_cpu_name", lambda: "another")
    assert jit.source_hash() == sources
    assert jit.kernels_hash() != kernels
