"""Compilation of the kernels: one process at a time, said on the standard error, tidied up."""

import os
import queue
import subprocess
import sys
import threading
import time

import pytest

from derail_ros.engine import warming
from derail_ros.engine.jit import FOLDER_PREFIX

LIMIT = 250.0
"""Wall time after which a test gives up waiting, s: generous, for machines that are busy."""
linux = pytest.mark.skipif(sys.platform == "win32", reason="no file locks there")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder, and nothing to compile."""
    own = tmp_path / f"{FOLDER_PREFIX}own"
    own.mkdir()
    monkeypatch.setattr(warming, "CACHE_DIR", own)
    monkeypatch.setattr(warming, "_ready", threading.Event())
    monkeypatch.setattr(warming, "_use", None)
    return own


def test_messages_only_when_compiling(folder, monkeypatch, capsys):
    compiled = []
    monkeypatch.setattr(warming, "_exercise", lambda: compiled.append(1))
    warming.ensure_compiled()
    said = capsys.readouterr()
    assert said.out == ""
    assert "compiling" in said.err and "compiled in" in said.err
    assert compiled == [1]
    assert (folder / warming.COMPLETE).exists()
    warming.ensure_compiled()
    warming._ready.clear()  # another process
    warming.ensure_compiled(pytest.fail)
    assert compiled == [1]
    assert capsys.readouterr() == ("", "")


@linux
def test_a_second_process_waits_and_does_not_compile(folder, monkeypatch):
    code = (
        "import fcntl, sys, pathlib, time\n"
        f"folder = pathlib.Path({str(folder)!r})\n"
        "file = open(folder / 'lock', 'wb')\n"
        "fcntl.flock(file, fcntl.LOCK_EX)\n"
        "print('held', flush=True)\n"
        "time.sleep(0.5)\n"
        "(folder / 'complete').touch()\n"
    )
    monkeypatch.setattr(warming, "_exercise", lambda: pytest.fail("compiled"))
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    with other:
        assert other.stdout.readline() == "held\n"
        said = []
        warming.ensure_compiled(said.append)
    assert len(said) == 1 and "waiting" in said[0]


def test_a_folder_that_cannot_be_written(folder, monkeypatch):
    compiled = []
    monkeypatch.setattr(warming, "CACHE_DIR", folder / "missing")
    monkeypatch.setattr(warming, "_exercise", lambda: compiled.append(1))
    warming.ensure_compiled(lambda text: None)
    assert compiled == [1]


@linux
def test_if_the_compiling_process_is_killed_another_takes_over(tmp_path):
    go = tmp_path / "go"
    code = f"""
import os, time
from pathlib import Path
from derail_ros.engine import warming

def exercise():
    print("compiles", flush=True)
    while not Path({str(go)!r}).exists():
        time.sleep(0.01)

warming.CACHE_DIR = Path({str(tmp_path)!r})
warming._exercise = exercise
warming.ensure_compiled(lambda text: print(text.split()[0], flush=True))
print("ready", flush=True)
"""
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    processes, words = [], queue.Queue()

    def listen(k, process):
        for line in process.stdout:
            words.put((k, line.strip()))

    for k in range(4):
        processes.append(
            subprocess.Popen(
                [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
            )
        )
        threading.Thread(target=listen, args=(k, processes[k]), daemon=True).start()
    try:
        said = [words.get(timeout=LIMIT) for _ in range(5)]
        (first,) = (k for k, word in said if word == "compiles")
        # "compiling ..." by the one that does, "another ..." by the others
        assert sorted(word for _, word in said) == ["another"] * 3 + ["compiles", "compiling"]
        assert (first, "compiling") in said
        processes[first].kill()
        second = [words.get(timeout=LIMIT) for _ in range(2)]
        heir = second[0][0]
        assert second == [(heir, "compiling"), (heir, "compiles")]
        assert heir != first
        go.touch()
        rest = [words.get(timeout=LIMIT) for _ in range(4)]
        assert (heir, "compiled") in rest
        assert sorted(k for k, word in rest if word == "ready") == sorted({0, 1, 2, 3} - {first})
        assert [p.wait(LIMIT) for p in processes] == [-9 if k == first else 0 for k in range(4)]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_what_cannot_be_kept_is_said_and_compiled(folder, monkeypatch):
    compiled, said = [], []
    monkeypatch.setattr(warming, "CAN_KEEP", False)
    monkeypatch.setattr(warming, "_exercise", lambda: compiled.append(1))
    warming.ensure_compiled(said.append)
    warming.ensure_compiled(said.append)
    assert compiled == [1]
    assert len(said) == 1 and "cannot be written" in said[0] and str(folder) in said[0]


@linux
def test_stale_folders_go_unless_in_use(tmp_path):
    import fcntl

    month_ago = time.time() - 30 * 86400
    folders = {}
    for name in ("own", "old", "held", "recent", "half"):
        folders[name] = tmp_path / f"{FOLDER_PREFIX}{name}"
        folders[name].mkdir()
        if name != "half":
            (folders[name] / warming.COMPLETE).touch()
            if name != "recent":
                os.utime(folders[name] / warming.COMPLETE, (month_ago, month_ago))
    os.utime(folders["half"], (month_ago, month_ago))
    (tmp_path / "something else").mkdir()
    with open(folders["held"] / "use", "wb") as use:
        fcntl.flock(use, fcntl.LOCK_SH)
        removed = warming.remove_stale(tmp_path, folders["own"])
    assert sorted(f.name.removeprefix(FOLDER_PREFIX) for f in removed) == ["half", "old"]
    assert {f.name for f in tmp_path.iterdir()} == {
        "something else", *(f"{FOLDER_PREFIX}{name}" for name in ("own", "held", "recent"))
    }  # fmt: skip
