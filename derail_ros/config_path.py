"""Find the folder ``config/``: in the source tree or below an installation's ``share``.

The same files are found from a clone, an editable installation, a wheel in a virtual environment,
``pip install --target`` or ``--user``, and a colcon workspace (also with ``--symlink-install``).
"""

from __future__ import annotations

import functools
import os
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

PACKAGE = "derail_ros"


def config_dir() -> Path:
    """Return the folder with scenarios, rolling stock and node parameters.

    Raises
    ------
    FileNotFoundError
        The installation lacks it. The message lists where it was looked for.
    """
    return _find(Path(__file__).resolve().parent, os.environ.get("AMENT_PREFIX_PATH", ""))


def config_path(*parts: str) -> Path:
    """Return the path of a file or folder within ``config/``, existing or not.

    For names from outside (a scenario's name, say) the caller must refuse path separators first;
    as a second wall this function refuses whatever leads out of ``config/``.
    """
    base = config_dir()
    path = base.joinpath(*parts)
    if not path.resolve().is_relative_to(base.resolve()):
        raise ValueError(f"{'/'.join(parts)!r} leads out of the configuration folder")
    return path


@functools.lru_cache(maxsize=8)
def _find(package: Path, ament_prefix_path: str) -> Path:
    """Look for the folder, given the package's own place and the ROS 2 prefixes."""
    looked_at = []
    for candidate in _candidates(package, ament_prefix_path):
        if candidate.is_dir():
            return candidate
        looked_at.append(str(candidate))
    raise FileNotFoundError(
        f"the configuration files of {PACKAGE} are missing; looked at " + ", ".join(looked_at)
    )


def _candidates(package: Path, ament_prefix_path: str) -> Iterator[Path]:
    """Yield where ``config/`` may be, the surest first."""
    if (package.parent / "package.xml").is_file() and (package.parent / "setup.py").is_file():
        yield package.parent / "config"  # a clone: config/ lies beside the package
    share = Path("share") / PACKAGE / "config"
    # prefix/lib/python3.x/site-packages/derail_ros: the prefix is some folder above
    for parent in list(package.parents)[:5]:
        yield parent / share
    for prefix in filter(None, ament_prefix_path.split(os.pathsep)):
        yield Path(prefix) / share
    yield Path(sysconfig.get_path("data")) / share
    yield Path(sys.prefix) / share
