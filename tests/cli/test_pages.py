"""README and tutorials: their commands, files and programs do what the pages say."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from derail_ros.cli import main

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"


def blocks(page: Path, kind: str) -> list[str]:
    """The code blocks of a page."""
    return re.findall(rf"^```{kind}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def commands(page: Path) -> list[list[str]]:
    """The commands of a page that run as they stand."""
    lines = "".join(blocks(page, "bash")).splitlines()
    found = [shlex.split(line, comments=True) for line in lines if line.strip()]
    assert all(words[0] == "derail" for words in found)
    return [words[1:] for words in found]


def write_files(page: Path) -> None:
    """The files that a page asks its reader to save."""
    text = page.read_text(encoding="utf-8")
    for name, content in re.findall(r"Save this as `([\w.]+)`:\n\n```\w+\n(.*?)```", text, re.S):
        Path(name).write_text(content, encoding="utf-8")


PAGES = ["first_derailment", "own_train", "study", "predict", "reconstruct"]


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_tutorial(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = TUTORIALS / f"{page}.md"
    write_files(path)
    for words in commands(path):
        assert main(words) == 0, (words, capsys.readouterr().err)
    made = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")}
    # what the text names is there
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:review|out|page|forecast|findings)/[\w.]+)`", text):
        assert name in made, name


def test_the_commands_of_the_readme(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_files(TUTORIALS / "own_train.md")
    readme = ROOT / "README.md"
    for words in commands(readme):
        assert main(words) == 0, (words, capsys.readouterr().err)
    film = Path("accident.gif").stat().st_size
    kept = (ROOT / "docs" / "images" / "derailment.gif").stat().st_size
    assert max(film, kept) < 2_000_000
    (program,) = blocks(readme, "python")
    capsys.readouterr()
    exec(compile(program, "README.md", "exec"), {})
    derailed, seconds, force = capsys.readouterr().out.split()
    assert int(derailed) > 0 and float(seconds) > 1.0 and float(force) > 1e6


def test_the_readme_keeps_its_two_commands():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in ("run", "test"):
        assert re.search(rf"^    make {target}\b", readme, re.M)


def test_figures_of_the_readme_are_those_of_the_evidence():
    """What is quoted stands in the page that a command writes."""

    def plain(name: str) -> str:
        return " ".join((ROOT / name).read_text(encoding="utf-8").split())

    quoted = re.search(r"it derails (as many cars.*?begin at once)", plain("README.md"))[1]
    evidence = plain("docs/evidence.md").replace("as reported from", "as were reported from")
    assert quoted in evidence
    accidents = (ROOT / "docs" / "accidents.md").read_text(encoding="utf-8")
    table = accidents.split("<!-- results: broken_rail -->")[1]
    trains = sum(int(n) for n in re.search(r"^\| trains \|(.*)\|$", table, re.M)[1].split("|"))
    share = re.search(r"^\| `planar` \| ([\d.]+) \|", table.split("results: agreement")[1], re.M)
    for page in ("README.md", "docs/evidence.md"):
        said = plain(page)
        assert f"Beside {trains} " in said
        assert f"{float(share[1]):.1f} times as many" in said
    assert "as many as reported from 30 to 90 km/h" in plain("docs/accidents.md")
