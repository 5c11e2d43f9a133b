"""The command line from outside: what help imports, errors in one line, signals, exit codes."""

import signal
import subprocess
import sys

import pytest

PYTHON = [sys.executable, "-m", "derail_ros.cli"]


def shell(*arguments, **kwargs):
    return subprocess.run(
        [*PYTHON, *arguments], capture_output=True, text=True, timeout=280, **kwargs
    )


@pytest.mark.parametrize("command", ["", "simulate", "scenarios", "estimate", "validate"])
def test_help_imports_nothing_heavy(command):
    code = (
        "import sys; from derail_ros.cli import main\n"
        f"code = main({[*command.split(), '--help']!r})\n"
        "heavy = {'numpy', 'numba', 'scipy', 'pandas', 'matplotlib', 'yaml',\n"
        "         'rosbags', 'mcap', 'rclpy', 'dask', 'asyncio', 'multiprocessing'}\n"
        "found = heavy & set(sys.modules)\n"
        "sys.exit(code if not found else f'imported {found}')"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert "--help" in answer.stdout


def test_no_arguments_show_the_help(derail):
    answer = derail()
    assert answer.code == 0
    assert "Usage" in answer.out


def test_version(derail):
    from derail_ros import __version__

    assert derail("--version").out.strip() == f"derail_ros {__version__}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulat"], "No such command"),
        (["simulate"], "scenario"),
        (["simulate", "no_such_train"], "no_such_train"),
        (["simulate", "/no/such/file.yaml"], "/no/such/file.yaml"),
        (["simulate", "base_train", "--set", "train.speed_kmh=-3"], "train.speed_kmh"),
        (["simulate", "base_train", "--set", "train.sped_kmh=3"], "train.sped_kmh"),
        (["simulate", "base_train", "--set", "nothing"], "--set"),
        (["simulate", "base_train", "--ensemble", "0"], "--ensemble"),
        (["simulate", "base_train", "--jobs", "0"], "--jobs"),
        (["simulate", "base_train", "--seed", "-1"], "--seed"),
        (["estimate", "bar-4"], "bar-4"),
        (["estimate", "bar-1", "--cars", "some"], "--cars"),
        (["estimate", "bar-1", "--speed-kmh", "-10"], "speed"),
        (["estimate", "bar-2", "--form", "right"], "form"),
    ],
)
def test_bad_input_is_one_line_and_2(derail, arguments, words):
    answer = derail(*arguments)
    assert answer.code == 2
    assert answer.out == ""
    assert words.lower() in answer.err.lower()
    assert len(answer.err.strip().splitlines()) == 1
    assert answer.err.startswith("derail: ")


def test_a_mistake_in_a_file_names_the_line(derail, small):
    with open(small, encoding="utf-8") as file:
        line = len(file.readlines()) + 2
    with open(small, "a", encoding="utf-8") as file:
        file.write("brakes:\n  delay_s: soon\n")
    answer = derail("simulate", small)
    assert answer.code == 2
    assert f"small.yaml:{line}: brakes.delay_s: " in answer.err


def test_a_folder_with_something_in_it_is_refused(derail, small, tmp_path):
    answer = derail("simulate", small, "-o", tmp_path)
    assert answer.code == 2
    assert "not empty" in answer.err


def test_a_reader_that_goes_away_is_no_error():
    process = subprocess.Popen(
        [*PYTHON, "scenarios"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    _, err = process.communicate(timeout=250)
    assert b"Traceback" not in err


TELLING = """
import sys
from derail_ros import models
from derail_ros.cli import main
made, build = [], models.build
def counted(*arguments):
    made.append(0)
    if len(made) == 20:
        print("running", flush=True)
    return build(*arguments)
models.build = counted
sys.exit(main(sys.argv[1:]))
"""
"""A ``derail`` that says when it has begun with its twentieth run."""


# both signals have one handler
@pytest.mark.parametrize(("number", "jobs"), [(signal.SIGINT, "2"), (signal.SIGTERM, "1")])
def test_interrupted(number, jobs, small):
    from derail_ros.engine import warm_up

    warm_up()
    arguments = ["simulate", small, "--ensemble", "100000", "--jobs", jobs, "--json"]
    process = subprocess.Popen(
        [sys.executable, "-c", TELLING, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "running\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=250)
    assert process.returncode == 130
    assert out == ""
    assert err.strip().splitlines()[-1] == "derail: interrupted"
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("start", "end", "words"),
    [
        (
            50.0,
            60.0,
            "--start: 50 s is not before its end: the recording runs from 0 s to 26.72 s",
        ),
        (26.72, None, "--start: 26.72 s is not before its end"),
        (None, 0.0, "--end: 0 s is not after its beginning: the recording runs from 0 s"),
        (5.0, 4.0, "--end: 4 s is not after --start, 5 s"),
    ],
)
def test_a_film_of_nothing_is_refused_in_the_words_that_were_asked(start, end, words):
    from derail_ros.commands.common import CommandFailure
    from derail_ros.commands.recordings import check_times

    with pytest.raises(CommandFailure) as info:
        check_times(start, end, 0.0, 26.72)
    assert words in str(info.value)


@pytest.mark.parametrize("times", [(None, None), (26.0, 60.0), (-1.0, 0.1)])
def test_a_film_of_something_is_not_refused(times):
    from derail_ros.commands.recordings import check_times

    check_times(*times, 0.0, 26.72)


@pytest.mark.parametrize(
    "command",
    ["scenarios", "models", "estimate bar-1", "joint-velocities", "accidents", "study list"],
)
def test_json_says_what_it_is(derail, command):
    answer = derail(*command.split(), "--json")
    assert answer.code == 0, answer.err
    assert answer.json["schema"].startswith("derail_ros/")
    assert answer.json["schema_version"] >= 1


def test_the_models_are_listed(derail):
    found = {m["name"]: m for m in derail("models", "--json").json["models"]}
    assert found["planar"]["engine"]
    assert "rail_breaks" in found["planar"]["features"]
    assert not found["anderson"]["engine"]
    assert all(m["words"] for m in found.values())
    table = derail("models").out
    assert all(name in table for name in found)
