"""Build of derail_ros, for pip and for colcon (ament_python) alike.

The metadata are here and not in pyproject.toml because the setuptools of older ROS 2
distributions do not read them there.
"""

import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = "derail_ros"
ROOT = Path(__file__).resolve().parent

BASE = [
    "numpy>=1.26,<3",
    "numba>=0.60",
    "pydantic>=2.7,<3",
    "PyYAML>=6",
    "typer>=0.12",
    "rich>=13",
    "matplotlib>=3.8",
    "rosbags>=0.10.9",
    "mcap>=1.6",
    "scipy>=1.11",
]

# ROS 2 Kilted as wheels (x86-64 Linux): the versions that were tested together.
# Not needed beside a ROS 2 distribution.
ROS = [
    "ros-rclpy==9.1.2",
    "ros-rmw-fastrtps-cpp==9.3.3",
    "ros-rosidl-default-runtime==1.7.1",
    "ros-rosidl-generator-py==0.24.2",
    "ros-builtin-interfaces==2.3.0",
    "ros-rosgraph-msgs==2.3.0",
    "ros-std-msgs==5.5.1",
    "ros-std-srvs==5.5.1",
    "ros-geometry-msgs==5.5.1",
    "ros-sensor-msgs==5.5.1",
    "ros-nav-msgs==5.5.1",
    "ros-action-msgs==2.3.0",
    "ros-visualization-msgs==5.5.1",
    "ros-diagnostic-msgs==5.5.1",
]

STUDIES = [
    "pandas>=2",
    "pyarrow>=15",
    "SALib>=1.5",
    "dask[distributed]>=2024.1",
]

# Maps: reference systems of projection, and polygons.
SITE = ["pyproj>=3.6", "shapely>=2"]

# The engine in three dimensions, and its view in a browser.
SPATIAL = ["mujoco>=3.2", "trimesh>=4", "viser>=1.0"]

# Films as MP4: the ffmpeg that comes as a wheel. GIF needs nothing.
VIDEO = ["imageio-ffmpeg>=0.5"]

# The documentation site (`make docs`) and its notebooks.
DOCS = [
    "mkdocs-material>=9.5",
    "mkdocstrings[python]>=0.26",
    "nbformat>=5",
    "nbclient>=0.10",
    "ipykernel>=6",
]

TEST = [
    *VIDEO,
    *DOCS,
    *SITE,
    *SPATIAL,
    "pytest>=8",
    "pytest-timeout>=2.3",
    "pytest-xdist>=3.5",
    "hypothesis>=6.100",
    "mcap-ros2-support>=0.5",
    "selenium>=4.15",
    "sympy>=1.12",
    "jsonschema>=4",
    "setuptools>=68",
    "catkin-pkg>=1",
]

BENCH = [
    "mujoco>=3",
    "pymunk>=7",
    "exudyn>=1.9",
]

DEV = [
    *TEST,
    "ruff==0.17.6",
    "mypy==2.4.1",
    "types-PyYAML",
    "import-linter==2.15",
    "codespell==2.4.3",
    "proselint==0.16.0",
]


def version() -> str:
    """Return the version, which derail_ros/__init__.py holds."""
    text = (ROOT / NAME / "__init__.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "([^"]+)"$', text, re.MULTILINE)
    if match is None:
        raise RuntimeError("derail_ros/__init__.py has no __version__")
    return match.group(1)


def readme() -> str:
    """Return the text of the README, if there is one."""
    path = ROOT / "README.md"
    return path.read_text(encoding="utf-8") if path.exists() else ""


def files(folder: str, target: str, pattern: str = "*") -> list[tuple[str, list[str]]]:
    """List the files below ``folder`` for installation below ``target``, folder by folder."""
    found: dict[str, list[str]] = {}
    for path in sorted((ROOT / folder).rglob(pattern)):
        relative = path.relative_to(ROOT / folder)
        hidden = any(part.startswith((".", "__")) for part in relative.parts)
        if path.is_file() and not hidden and path.suffix != ".pyc":
            place = "/".join([target, *relative.parts[:-1]])
            found.setdefault(place, []).append(path.relative_to(ROOT).as_posix())
    return sorted(found.items())


def data(package: str) -> list[str]:
    """List what a package has beside code: pages, tables, definitions."""
    folder = ROOT / package
    return [
        path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix not in (".py", ".pyc")
    ]


PACKAGES = (NAME, "msg_adapters")

setup(
    name=NAME,
    version=version(),
    description="A simulator of train derailments, in Python and in ROS 2",
    long_description=readme(),
    long_description_content_type="text/markdown",
    author="The derail_ros developers",
    maintainer="The derail_ros developers",
    maintainer_email="derail_ros@users.noreply.github.com",
    license="Apache-2.0",
    keywords=["ROS 2", "train", "derailment", "multibody", "simulation", "safety"],
    classifiers=[
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering :: Physics",
    ],
    packages=find_packages(include=[*PACKAGES, *(f"{package}.*" for package in PACKAGES)]),
    package_data={package: data(package) for package in PACKAGES},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *files("config", f"share/{NAME}/config"),
        *files("launch", f"share/{NAME}/launch", "*.launch.py"),
        *files("scripts", f"lib/{NAME}"),
    ],
    python_requires=">=3.10",
    install_requires=BASE,
    extras_require={
        "ros": ROS,
        "studies": STUDIES,
        "bench": BENCH,
        "docs": DOCS,
        "site": SITE,
        "spatial": SPATIAL,
        "video": VIDEO,
        "test": TEST,
        "dev": DEV,
    },
    entry_points={"console_scripts": ["derail = derail_ros.cli:main"]},
    zip_safe=False,
)
