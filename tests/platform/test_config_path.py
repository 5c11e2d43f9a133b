"""config/ is found from every kind of installation."""

from pathlib import Path

import pytest

from derail_ros import config_path

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def forget():
    """The lookup remembers; each test begins anew."""
    config_path._find.cache_clear()
    yield
    config_path._find.cache_clear()


def package_in(folder: Path) -> Path:
    package = folder / "derail_ros"
    package.mkdir(parents=True)
    return package


def share_in(prefix: Path) -> Path:
    share = prefix / "share" / "derail_ros" / "config"
    share.mkdir(parents=True)
    return share


def test_a_clone_uses_its_own_files():
    assert config_path.config_dir() == ROOT / "config"


@pytest.mark.parametrize(
    "place",
    [
        "lib/python3.11/site-packages",  # virtual environment, colcon install, --user, --prefix
        "local/lib/python3.10/dist-packages",  # Debian's, Ubuntu's
        ".",  # pip install --target
    ],
)
def test_an_installation_uses_the_share_of_its_prefix(tmp_path, place):
    share = share_in(tmp_path)
    package = package_in(tmp_path / place)
    assert config_path._find(package, "") == share


def test_a_prefix_of_ros_is_used_when_the_package_lies_elsewhere(tmp_path):
    share = share_in(tmp_path / "install" / "derail_ros")
    package = package_in(tmp_path / "build" / "derail_ros")
    prefixes = f"{tmp_path / 'other'}:{tmp_path / 'install' / 'derail_ros'}"
    assert config_path._find(package, prefixes) == share


def test_a_missing_folder_is_said_with_the_places_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr(config_path.sysconfig, "get_path", lambda _: str(tmp_path / "data"))
    monkeypatch.setattr(config_path.sys, "prefix", str(tmp_path / "prefix"))
    package = package_in(tmp_path / "a" / "b" / "c" / "d" / "e" / "f")
    with pytest.raises(FileNotFoundError, match="looked at") as error:
        config_path._find(package, "")
    assert str(tmp_path / "prefix") in str(error.value)


def test_paths_do_not_lead_out_of_the_folder():
    assert config_path.config_path("scenarios", "x.yaml") == ROOT / "config/scenarios/x.yaml"
    for bad in ("../setup.py", "/etc/passwd", "scenarios/../../x"):
        with pytest.raises(ValueError, match="leads out"):
            config_path.config_path(bad)
