"""Manifests, setup.py and the tree agree; what is installed is complete."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from catkin_pkg.package import parse_package

from derail_ros.nodes.parameters import NODES
from tests.conftest import UNCHECKED
from tests.platform import launch_stand_in as stand_in

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("derail_ros", "msg_adapters")

# rosdep keys of package.xml -> names at PyPI, where they differ from python3-NAME
ROSDEP = {
    "python3-mcap-pip": "mcap",
    "python3-rosbags-pip": "rosbags",
    "python3-yaml": "pyyaml",
}
# names at PyPI -> what is imported, where it differs
IMPORTS = {"pyyaml": "yaml", "dask": "dask", "salib": "SALib"}
# modules that a base dependency brings and that may be used with it
BROUGHT = {
    "matplotlib": {"PIL"},
    "numba": {"llvmlite"},
    "pydantic": {"pydantic_core", "annotated_types"},
    "mcap": {"lz4", "zstandard"},
}
# what a ROS 2 distribution always has with rclpy, and what is built here or is ROS's own tooling
NOT_ON_PYPI = {
    "derail_msgs",
    "foxglove_msgs",
    "launch",
    "launch_ros",
    "simulation_interfaces",
    "tf2_msgs",
}
LINTERS = {"ruff", "mypy", "import-linter", "codespell", "proselint"}
WHEELS_ONLY = {"rmw_fastrtps_cpp", "rosidl_default_runtime", "rosidl_generator_py"}


@pytest.fixture(scope="module")
def arguments() -> dict:
    """Return the arguments that setup.py gives to setuptools."""
    import setuptools

    given = {}
    original = setuptools.setup
    setuptools.setup = given.update
    folder = os.getcwd()
    os.chdir(ROOT)
    try:
        spec = importlib.util.spec_from_file_location("derail_ros_setup", ROOT / "setup.py")
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    finally:
        setuptools.setup = original
        os.chdir(folder)
    return given


def name(requirement: str) -> str:
    """Return the name in a requirement, in lower case and without extras."""
    return re.match(r"[\w.-]+", requirement)[0].lower()


def manifest(path: Path) -> ElementTree.Element:
    return ElementTree.parse(path).getroot()


def dependencies(path: Path, *tags: str) -> set[str]:
    return {element.text for tag in tags for element in manifest(path).findall(tag)}


def test_manifests_are_valid():
    for path in (ROOT / "package.xml", ROOT / "derail_msgs" / "package.xml"):
        warnings = []
        package = parse_package(str(path), warnings=warnings)
        package.validate(warnings=warnings)
        assert warnings == []


def test_the_manifest_names_package_and_version_of_setup_py(arguments):
    root = manifest(ROOT / "package.xml")
    assert root.findtext("name") == arguments["name"]
    assert root.findtext("version") == arguments["version"]
    assert root.findtext("license") == arguments["license"]
    assert root.findtext("export/build_type") == "ament_python"
    assert manifest(ROOT / "derail_msgs" / "package.xml").findtext("export/build_type") == (
        "ament_cmake"
    )


def test_dependencies_of_manifest_and_setup_py_agree(arguments):
    needed = dependencies(ROOT / "package.xml", "depend", "exec_depend")
    python = {key for key in needed if key.startswith("python3-")}
    from_manifest = {ROSDEP.get(key, key.removeprefix("python3-")) for key in python}
    assert from_manifest == {name(r) for r in arguments["install_requires"]}

    ros = arguments["extras_require"]["ros"]
    wheels = {name(r).removeprefix("ros-").replace("-", "_") for r in ros}
    assert needed - python - NOT_ON_PYPI == wheels - WHEELS_ONLY

    tests = dependencies(ROOT / "package.xml", "test_depend")
    for key in tests:
        assert key.removeprefix("python3-") in {
            name(r) for r in arguments["extras_require"]["test"]
        }


def test_ros_wheels_and_linters_are_pinned(arguments):
    extras = arguments["extras_require"]
    pinned = [*extras["ros"], *(r for r in extras["dev"] if name(r) in LINTERS)]
    assert len(pinned) >= 10
    assert all(re.fullmatch(r"[\w-]+==[\d.]+", requirement) for requirement in pinned)


def test_constraints_name_every_requirement(arguments):
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    known = {
        re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower()
        for line in text.splitlines()
        if not line.startswith("#")
    }
    required = [*arguments["install_requires"], *arguments["extras_require"]["ros"]]
    required += [*arguments["extras_require"]["studies"], *arguments["extras_require"]["dev"]]
    missing = {re.sub(r"[-_.]+", "-", name(r)) for r in required} - known
    assert not missing, f"run .ci/constraints.py: {missing}"


def test_files_of_the_ament_package_are_installed(arguments):
    installed = {
        f"{target}/{Path(file).name}"
        for target, files in arguments["data_files"]
        for file in files
    }
    assert "share/ament_index/resource_index/packages/derail_ros" in installed
    assert "share/derail_ros/package.xml" in installed
    for path in (ROOT / "launch").glob("*.launch.py"):
        assert f"share/derail_ros/launch/{path.name}" in installed
    for executable in ("simulator", "recorder", "player"):
        assert f"lib/derail_ros/{executable}" in installed
    for path in (ROOT / "config").rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            assert f"share/derail_ros/{path.relative_to(ROOT).as_posix()}" in installed
    assert all((ROOT / file).is_file() for _, files in arguments["data_files"] for file in files)


def test_every_folder_with_code_is_a_package(arguments):
    """A forgotten __init__.py works in a clone and is missing from the wheel."""
    folders = {
        path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
    }
    assert folders == set(arguments["packages"]), "and nothing else: no tests, no research"


def test_data_in_the_packages_is_installed(arguments):
    for package in PACKAGES:
        listed = set(arguments["package_data"][package])
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc"):
                assert path.relative_to(ROOT / package).as_posix() in listed


def imported(path: Path) -> dict[str, bool]:
    """Return the top-level modules that a file imports; True where importing the file does so."""
    found: dict[str, bool] = {}

    def visit(node: ast.AST, at_once: bool) -> None:
        for child in ast.iter_child_nodes(node):
            names = []
            if isinstance(child, ast.Import):
                names = [alias.name for alias in child.names]
            elif isinstance(child, ast.ImportFrom) and not child.level and child.module:
                names = [child.module]
            for top in (module.partition(".")[0] for module in names):
                found[top] = found.get(top, False) or at_once
            lazy = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Try))
            typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
            visit(child, at_once and not lazy and not typing)

    visit(ast.parse(path.read_text(encoding="utf-8")), True)
    return found


SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


@pytest.fixture(scope="module")
def modules(arguments) -> dict[str, set[str]]:
    """Return the modules that the base and the extras bring."""

    def of(requirements: list[str]) -> set[str]:
        return {IMPORTS.get(name(r), name(r).replace("-", "_")) for r in requirements}

    extras = arguments["extras_require"]
    ros = {re.sub(r"^ros_", "", module) for module in of(extras["ros"])}
    return {
        "base": of(arguments["install_requires"]).union(*BROUGHT.values()),
        "ros": ros | {"derail_msgs", "rcl_interfaces"},
        "studies": of(extras["studies"]) | {"distributed"},
        "video": of(extras["video"]),
        "site": of(extras["site"]),
        "spatial": of(extras["spatial"]),
        "figures": {"mpl_toolkits"},
    }


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_what_a_module_imports_is_a_declared_dependency(path, modules):
    """At once: the base only. Within functions or try, or behind a model's name: extras too."""
    own = {*sys.stdlib_module_names, *PACKAGES, "tomllib", "tf2_msgs", "simulation_interfaces"}
    anything = own.union(*modules.values())
    relative = path.relative_to(ROOT).as_posix()
    base = own | modules["base"] | modules["figures"]
    if relative == "derail_ros/spatial/simulation.py":  # imported when the model is asked for
        base |= modules["spatial"]
    for module, at_once in imported(path).items():
        assert module in anything, f"{relative} imports {module}, which nothing declares"
        if at_once:
            assert module in base, (
                f"{relative} imports {module} at once: it is not a base dependency"
            )


@pytest.mark.parametrize("executable", ["simulator", "recorder", "player"])
def test_executables_start_the_nodes(executable):
    path = ROOT / "scripts" / executable
    text = path.read_text(encoding="utf-8")
    assert os.access(path, os.X_OK)
    assert text.startswith("#!/usr/bin/env python3\n")
    compile(text, str(path), "exec")
    assert f"from derail_ros.nodes.{executable} import main" in text


def test_launch_files_compile():
    files = sorted((ROOT / "launch").glob("*"))
    assert {path.name for path in files if path.is_file()} >= {
        "simulator.launch.py",
        "simulator_with_recorder.launch.py",
        "simulator_with_rviz.launch.py",
    }
    for path in files:
        if path.is_file():
            assert path.name.endswith(".launch.py")
            tree = ast.parse(path.read_text(encoding="utf-8"))
            assert "generate_launch_description" in {
                node.name for node in tree.body if isinstance(node, ast.FunctionDef)
            }


def started(path: Path, **given: str) -> list:
    """What the launch file of the simulator starts with arguments given."""
    with stand_in.imported():
        entities = list(described(path).entities)
        declared = {e.name: e.default_value for e in entities if hasattr(e, "default_value")}
        (opaque,) = (e for e in entities if isinstance(e, stand_in.OpaqueFunction))
        return opaque.function(stand_in.LaunchContext(declared | given))


SIMULATOR_LAUNCH = ROOT / "launch" / "simulator.launch.py"


def test_every_parameter_of_the_simulator_is_a_launch_argument():
    (node,) = started(SIMULATOR_LAUNCH, state_rate="20", record="~/bag", scenario='""')
    file, given = node.parameters
    assert stand_in.resolved(file, ROOT).name == "simulator.yaml"
    assert given == {"state_rate": 20.0, "record": "~/bag", "scenario": "", "use_sim_time": False}
    with stand_in.imported():
        declared = {e.name for e in described(SIMULATOR_LAUNCH).entities if hasattr(e, "name")}
    table = {parameter.name for parameter in NODES["simulator"]}
    assert declared == table | {"namespace", "params_file", "use_sim_time", "rviz"}


def test_what_is_given_to_a_launch_file_reaches_its_nodes():
    node, rviz = started(
        SIMULATOR_LAUNCH,
        namespace="north",
        params_file="/some/file.yaml",
        use_sim_time="true",
        scenario_dirs="[/a, /b]",
        rviz="true",
    )
    assert node.namespace == rviz.namespace == "north"
    assert node.parameters[0] == "/some/file.yaml"
    assert node.parameters[1] == {"scenario_dirs": ["/a", "/b"], "use_sim_time": True}
    options = dict(zip(rviz.arguments[::2], rviz.arguments[1::2]))
    assert stand_in.resolved(options["-d"], ROOT).is_file()
    assert ("/markers", "markers") in rviz.remappings


def test_a_slip_in_an_argument_is_told_and_arguments_of_others_are_not():
    told, _ = started(SIMULATOR_LAUNCH, speedfactor="2", bag="x", ros_namespace="/y")
    assert "no argument speedfactor; did you mean speed_factor?" in told.msg


def test_a_value_that_the_node_would_refuse_is_refused():
    with pytest.raises(ValueError, match="speed_factor must be 0 to 1000"):
        started(SIMULATOR_LAUNCH, speed_factor="-1")


def described(path: Path):
    """Return what a launch file describes, by whichever launch is imported."""
    spec = importlib.util.spec_from_file_location("launch_file", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name.partition(".")[0])
def test_what_launch_files_describe(path):
    """Nodes, parameters, arguments and files are there, so far as no launch is needed to say."""
    with stand_in.imported():
        entities = list(described(path).entities)
        declared, used, found = {}, set(), []
        included = [e for e in entities if isinstance(e, stand_in.IncludeLaunchDescription)]
        for include in included:
            file = stand_in.resolved(include.launch_description_source, ROOT)
            inner = {e.name for e in described(file).entities if hasattr(e, "default_value")}
            assert {name for name, _ in include.launch_arguments or ()} <= inner
    for entity in entities:
        if isinstance(entity, stand_in.DeclareLaunchArgument):
            assert isinstance(entity.default_value, str) and entity.description
            declared[entity.name] = entity.default_value
        elif isinstance(entity, stand_in.Node):
            found.append(entity.executable)
            if entity.package == "derail_ros":
                assert (ROOT / "scripts" / entity.executable).is_file()
                used |= checked_parameters(entity, declared)
            else:
                options = dict(zip(entity.arguments[::2], entity.arguments[1::2]))
                assert stand_in.resolved(options["-d"], ROOT).is_file()
        else:
            assert entity in included or isinstance(entity, stand_in.OpaqueFunction)
    # An argument that is declared and goes nowhere is one that does nothing.
    opaque = [e for e in entities if isinstance(e, stand_in.OpaqueFunction)]
    assert opaque or used | {"namespace"} == set(declared) | {"namespace"}
    expected = {"simulator_with_recorder": ["recorder"]}.get(path.name.partition(".")[0], [])
    assert found == expected and bool(included) != bool(opaque)


def checked_parameters(node, declared) -> set[str]:
    """Hold a node's parameters against its table; return the arguments that they take."""
    table = {parameter.name: parameter for parameter in NODES[node.executable]}
    used = set()
    for source in node.parameters:
        if not isinstance(source, dict):
            text = stand_in.resolved(source, ROOT).read_text(encoding="utf-8")
            assert set(yaml.safe_load(text)["/**"]["ros__parameters"]) <= set(table)
            continue
        for name, value in source.items():
            argument = value.value.variable_name
            used.add(argument)
            # launch makes the value of the text; the node must not be given another type.
            assert value.value_type is type(table[name].default), name
            table[name].check(value.value_type(declared[argument]))
    return used


def test_the_stand_in_of_launch_refuses_what_launch_does_not_have():
    with stand_in.imported():
        with pytest.raises(ImportError):
            importlib.import_module("launch_ros.descriptions")
        with pytest.raises(TypeError):
            stand_in.Node(package="derail_ros", executable="simulator", params=[])
    for name in stand_in.MODULES:
        assert getattr(sys.modules.get(name), "LaunchDescription", None) is not (
            stand_in.LaunchDescription
        )


def test_launch_files_describe():
    """With launch itself, which only a ROS 2 distribution has."""
    missing = [name for name in ("launch", "launch_ros") if importlib.util.find_spec(name) is None]
    folder = importlib.util.find_spec("launch")
    # Our own folder of that name is a namespace package at best.
    if missing or folder.origin is None:
        pytest.skip(f"{UNCHECKED}launch files by launch itself: not on PyPI and not installed")
    launch = importlib.import_module("launch")
    for path in LAUNCH_FILES:
        assert isinstance(described(path), launch.LaunchDescription)


def test_the_installed_version_is_that_of_the_tree(arguments):
    assert metadata.version("derail_ros") == arguments["version"]


def test_citation_and_changelog_know_the_version(arguments):
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {arguments['version']}\n" in citation
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "## [Unreleased]" in changelog or f"## [{arguments['version']}]" in changelog


def test_make_lists_its_targets():
    answer = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    for target in ("env", "run", "test", "verify", "bench", "clean"):
        assert f"make {target}" in answer.stdout
