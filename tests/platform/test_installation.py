"""A wheel of the tree, installed: complete, executable, and it finds its configuration."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TREE = ["derail_ros", "msg_adapters", "config", "launch", "resource", "scripts"]
FILES = ["setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md", "LICENSE"]
DATA = "derail_ros-{version}.data/data/"


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    """A copy of the tree, so that nothing is left behind in it."""
    copy = tmp_path_factory.mktemp("tree") / "tree"
    for name in TREE:
        shutil.copytree(
            ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    for name in FILES:
        shutil.copy(ROOT / name, copy / name)
    return copy


def built(source: Path, folder: Path) -> Path:
    """The wheel of a tree or of a source distribution."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    command += ["--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def wheel(tree, tmp_path_factory) -> Path:
    """Build a wheel."""
    pytest.importorskip("setuptools")
    return built(tree, tmp_path_factory.mktemp("wheel"))


def files(folder: Path) -> set[Path]:
    """Return the files below a folder, hidden ones left out."""
    return {
        path.relative_to(folder)
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }


def run_elsewhere(folder: Path, path: Path, code: str) -> str:
    """Run a Python without this environment's packages but with those below ``path``."""
    program = f"import sys; sys.path.insert(0, {str(path)!r})\n{code}"
    answer = subprocess.run(
        [sys.executable, "-I", "-S", "-c", program],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    )
    return answer.stdout.strip()


def test_the_wheel_has_every_file_of_the_tree(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    data = DATA.format(version=wheel.name.split("-")[1])
    for package in ("derail_ros", "msg_adapters"):
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                assert path.relative_to(ROOT).as_posix() in names
    for path in (ROOT / "config").rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            assert f"{data}share/derail_ros/{path.relative_to(ROOT).as_posix()}" in names
    assert not any(name.startswith(("tests", "docs", "launch/")) for name in names)


def test_a_source_distribution_makes_the_same_wheel(wheel, tree, tmp_path):
    command = [sys.executable, "setup.py", "--quiet", "sdist", "--dist-dir", str(tmp_path)]
    subprocess.run(command, cwd=tree, check=True, capture_output=True)
    (source,) = tmp_path.glob("*.tar.gz")
    again = built(source, tmp_path / "wheel")
    assert again.name == wheel.name
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as other:
        assert sorted(one.namelist()) == sorted(other.namelist())
        text = next(one.read(n).decode() for n in one.namelist() if n.endswith("METADATA"))
    assert "# derail_ros" in text, "the README is the page of the package"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_clean_environment_without_compiler_and_ros(wheel, tmp_path):
    """`pip install` of the wheel with what it needs (from the package index), and a run."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "env")], check=True)
    bin_ = tmp_path / "env" / "bin"
    environment = {"PATH": str(bin_), "HOME": str(tmp_path), "LANG": "C.UTF-8"}
    environment |= {k: v for k, v in os.environ.items() if k.startswith(("PIP_", "SSL_"))}
    install = [bin_ / "python", "-m", "pip", "install", "--quiet"]
    install += ["--constraint", ROOT / "constraints.txt", wheel]
    subprocess.run(install, check=True, env=environment)
    short = ["--set", "train.consist.0.count=8", "--json"]
    answer = subprocess.run(
        ["derail", "simulate", "base_train", *short],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        executable=str(bin_ / "derail"),
    )
    assert answer.returncode == 0, answer.stderr
    assert '"cars_derailed": ' in answer.stdout
    has = [str(bin_ / "python"), "-c", "import rclpy"]
    assert subprocess.run(has, env=environment, capture_output=True).returncode == 1


@pytest.mark.parametrize("how", ["prefix", "target"])
def test_an_installation_finds_its_configuration(wheel, tmp_path, how):
    folder = tmp_path / "there"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--ignore-installed", f"--{how}", str(folder), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    (package,) = folder.rglob("derail_ros/__init__.py")
    code = "from derail_ros.config_path import config_dir; print(config_dir())"
    found = Path(run_elsewhere(tmp_path, package.parents[1], code))
    assert found == folder / "share" / "derail_ros" / "config"
    assert files(found) == files(ROOT / "config")
    if how == "target":
        return  # pip leaves out executables there
    for executable in ("simulator", "recorder", "player"):
        path = folder / "lib" / "derail_ros" / executable
        assert path.stat().st_mode & 0o111


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("can_keep", [True, False])
def test_a_read_only_installation_simulates(wheel, tmp_path, can_keep):
    folder = tmp_path / "there"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--target", str(folder), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    home.mkdir()
    temporary.mkdir()
    closed = [folder, home] if can_keep else [folder, home, temporary]
    program = [sys.executable, "-m", "derail_ros.cli", "simulate", "base_train"]
    if not can_keep:  # nor may Python find another folder for temporary files
        code = "import sys, tempfile; tempfile.tempdir = {!r}; sys.argv[0] = 'derail'\n"
        code += "from derail_ros.cli import main; sys.exit(main())"
        program[1:3] = ["-c", code.format(str(temporary))]
    if os.getuid() == 0:  # root, but held to the modes of files
        lose = "-dac_override,-dac_read_search"
        program[:0] = ["setpriv", "--bounding-set", lose]
        if shutil.which("setpriv") is None:
            pytest.skip("no setpriv to lose root's rights with")
    environment = {k: v for k, v in os.environ.items() if k not in ("DERAIL_CACHE_DIR",)}
    environment |= {
        "PYTHONPATH": str(folder), "HOME": str(home), "TMPDIR": str(temporary),
        "XDG_CACHE_HOME": str(home / ".cache"),
    }  # fmt: skip
    subprocess.run(["chmod", "-R", "a-w", *closed], check=True)
    try:
        done = subprocess.run(
            program, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
    finally:
        subprocess.run(["chmod", "-R", "u+w", *closed], check=True)
    assert done.returncode == 0, done.stderr
    assert "cars derailed" in done.stdout
    assert not list(home.iterdir())
    assert not list(folder.rglob("*.nb[ic]"))
    if can_keep:
        assert done.stderr.count("compiling the kernels") == 1
        assert str(temporary / f"derail_ros-{os.getuid()}") in done.stderr
        assert list(temporary.rglob("*.nbc"))
    else:
        assert done.stderr.count("cannot be written") == 1
        assert not list(temporary.iterdir())
