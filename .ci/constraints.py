#!/usr/bin/env python3
"""Write constraints.txt: the newest versions that pip resolves now, for each Python given.

    .ci/constraints.py python3.10 python3.11 python3.12 python3.13

`make env` holds to them, so that a release of some package on some morning breaks nothing here.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = "ros,studies,dev"
HEADER = """\
# Versions that were tested together; written by .ci/constraints.py.
# Only `make env` holds to them: who installs derail_ros with pip gets the ranges of setup.py.
"""


def build_requirements() -> list[str]:
    """Return what the wheels of derail_msgs and standard_interfaces are built with."""
    found = []
    for folder in ("derail_msgs", "standard_interfaces"):
        text = (ROOT / folder / "pyproject.toml").read_text(encoding="utf-8")
        found += tomllib.loads(text)["build-system"]["requires"]
    return found


def report(python: str, requirements: list[str], constraints: dict[str, str]) -> dict:
    """Return pip's report on an installation of the requirements that it does not make."""
    with tempfile.TemporaryDirectory() as folder:
        given = Path(folder) / "constraints.txt"
        given.write_text("".join(f"{name}=={v}\n" for name, v in constraints.items()))
        answer = Path(folder) / "report.json"
        command = [python, "-m", "pip", "install", "-q", "--dry-run", "--ignore-installed"]
        command += ["--constraint", str(given), "--report", str(answer), *requirements]
        subprocess.run(command, check=True)
        return json.loads(answer.read_text(encoding="utf-8"))


def resolve(python: str) -> tuple[str, dict[str, str]]:
    """Return the Python's version and what is needed there, name to version."""
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        own = f"{folder}/bin/python"
        subprocess.run([own, "-m", "pip", "install", "-q", "-U", "pip"], check=True)
        for requirements in ([f"{ROOT}[{EXTRAS}]"], build_requirements()):
            answer = report(own, requirements, found)
            for item in answer["install"]:
                name = item["metadata"]["name"]
                if name != "derail_ros":
                    found[name] = item["metadata"]["version"]
    return ".".join(answer["environment"]["python_version"].split(".")[:2]), found


def main(pythons: list[str]) -> None:
    """Resolve for each Python and write the union, with markers where versions differ."""
    resolved = dict(resolve(python) for python in pythons)
    lines = []
    for name in sorted({name for found in resolved.values() for name in found}, key=str.lower):
        versions = {python: found.get(name) for python, found in resolved.items()}
        given = {version for version in versions.values() if version}
        if len(given) == 1:
            lines.append(f"{name}=={given.pop()}")
            continue
        lines += [
            f'{name}=={version} ; python_version == "{python}"'
            for python, version in versions.items()
            if version
        ]
    (ROOT / "constraints.txt").write_text(HEADER + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:] or [sys.executable])
