#!/usr/bin/env python3
"""Check the nodes on the wheels of ROS 2 Jazzy, in an environment of their own.

    .ci/jazzy.py [FOLDER] [pytest arguments]

The project's environment has Kilted. FOLDER (default .venv/jazzy) gets an environment with Jazzy,
derail_msgs built for it, and what the tests of the nodes need; a second call takes what is there.
The wheels exist for Python 3.11 and 3.12.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PINS = ROOT / ".ci" / "jazzy.txt"
TOOLS = ["pytest", "pytest-timeout", "hypothesis", "scipy", "mcap", "mcap-ros2-support"]
TESTS = ["tests/nodes", "-m", "ros and not slow"]
PYTHONS = ("python3.11", "python3.12")


def environment() -> dict[str, str]:
    """Return this process's environment without what another Python's wheels left in it."""
    drop = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "PYTHONPATH")
    return {name: value for name, value in os.environ.items() if name not in drop}


def call(*command: str, **more: str) -> None:
    """Run a command; its failure is ours."""
    print("+", *command, flush=True)
    subprocess.run(command, cwd=ROOT, env=environment() | more, check=True)


def interpreter() -> str:
    """Return a Python that the wheels exist for and that runs."""
    for python in PYTHONS:
        if shutil.which(python) and not subprocess.run([python, "-c", ""], check=False).returncode:
            return python
    raise SystemExit(f"Jazzy's wheels need one of {', '.join(PYTHONS)}")


def messages(folder: Path) -> Path:
    """Copy derail_msgs with Jazzy's versions in its build requirements."""
    copy = folder / "derail_msgs"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(ROOT / "derail_msgs", copy, ignore=shutil.ignore_patterns("build"))
    pins = dict(re.findall(r"^([\w-]+)==(\S+)$", PINS.read_text(encoding="utf-8"), re.MULTILINE))
    file = copy / "pyproject.toml"
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        found = re.match(r'    "(ros-[\w-]+)==', line)
        if found is None:
            lines.append(line)
        elif found[1] in pins:  # the others belong to Kilted only
            lines.append(f'    "{found[1]}=={pins[found[1]]}",')
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return copy


def make(folder: Path) -> None:
    """Make the environment."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    call(interpreter(), "-m", "venv", str(folder / "env"))
    pip = [str(folder / "env" / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
    call(*pip, "install", "-q", "--upgrade", "pip")
    call(*pip, "wheel", "-q", "--no-deps", "--wheel-dir", str(folder), str(messages(folder)))
    (wheel,) = folder.glob("derail_msgs-*.whl")
    runtime = PINS.read_text(encoding="utf-8").partition("# to build with")[0].split("\n", 1)[1]
    # The project itself stays where it is; only what it needs is installed.
    call(*pip, "install", "-q", *runtime.split(), str(wheel), "--editable", ".", *TOOLS)
    (folder / "ready").touch()


def main(arguments: list[str]) -> None:
    """Make the environment if it is not there, and run the tests."""
    given = arguments and not arguments[0].startswith("-")
    folder = Path(arguments.pop(0)).resolve() if given else ROOT / ".venv" / "jazzy"
    if not (folder / "ready").exists():
        make(folder)
    python = str(folder / "env" / "bin" / "python")
    show = "import importlib.metadata as m; print('rclpy', m.version('ros-rclpy'))"
    call(python, "-c", f"import derail_msgs; {show}")
    call(python, "-m", "pytest", *(arguments or TESTS))


if __name__ == "__main__":
    main(sys.argv[1:])
