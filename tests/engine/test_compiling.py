"""The kernels' compiler: fewer questions and fewer kernels than numba's own, the same results."""

import operator
import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from numba.core import types

from derail_ros.engine import compiling, jit
from derail_ros.engine.compiling import KernelCompiler, forget_constants

OPTIONS = {"error_model": "numpy", "pipeline_class": KernelCompiler}


def inner(x, n, squared):
    return x**n if squared else x + n


def outer(x):
    return inner(x, 3, True) + inner(x, 4, False) + inner(x, 3, False)


def compiled(keep, **options):
    """A caller with constants, and what it calls; ``keep`` prepares the latter."""
    called = keep(njit(**options)(inner))
    space = {"inner": called}
    exec(  # the same caller with another `inner`
        "def outer(x):\n    return inner(x, 3, True) + inner(x, 4, False) + inner(x, 3, False)\n",
        space,
    )
    return njit(**options)(space["outer"]), called


def test_a_constant_is_any_number_of_its_type():
    caller, called = compiled(forget_constants, **OPTIONS)
    assert caller(1.7) == outer(1.7)
    assert called.signatures == [(types.float64, types.int64, types.boolean)]
    # as numba does it: one for each pair of constants
    caller, called = compiled(lambda kernel: kernel)
    assert caller(1.7) == outer(1.7)
    assert len(called.signatures) == 3


def arithmetic(a, k):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * (i + 1) - a[i] * (i + 2) + a[i] * (i + 3)
        if total > 3.0 and a[i] < 2.0 or i == k:
            total = -total
    return total


def test_each_question_is_asked_once(monkeypatch):
    asked = []
    ask = types.functions.BaseFunction.get_call_type

    def counted(self, context, args, kws):
        asked.append((self.typing_key, args))
        return ask(self, context, args, kws)

    monkeypatch.setattr(types.functions.BaseFunction, "get_call_type", counted)
    a = np.linspace(0.1, 2.3, 7)
    plain = njit(error_model="numpy")(arithmetic)(a, 3)
    numbers = sum(key is operator.add for key, _ in asked)
    assert numbers > 4
    asked.clear()
    assert njit(**OPTIONS)(arithmetic)(a, 3) == plain
    mine = [args for key, args in asked if key is operator.add]
    assert len(mine) == len(set(mine)) < numbers


def test_numba_is_left_as_it_was():
    before = types.Function.get_call_type
    assert njit(**OPTIONS)(arithmetic)(np.ones(2), 1) is not None
    assert types.Function.get_call_type is before
    assert not compiling._known
    # also if compiling fails
    with pytest.raises(Exception, match="(?i)typing"):
        njit(**OPTIONS)(lambda x: x.nothing)(1.0)
    assert types.Function.get_call_type is before
    assert not compiling._known and compiling._depth == 0


def test_another_numba_compiles_as_it_does(monkeypatch):
    monkeypatch.setattr(compiling, "types", type("types", (), {"Function": object}))
    assert njit(**OPTIONS)(arithmetic)(np.ones(3), 1) == arithmetic(np.ones(3), 1)
    # what has no such method is handed back
    assert forget_constants(arithmetic) is arithmetic


def test_a_kernel_has_an_entry_only_where_python_calls_it(monkeypatch):
    monkeypatch.setattr(jit, "CAN_KEEP", False)
    called = jit.jit(lambda x: x + 1.0)
    caller = jit.jit(lambda x: 2.0 * called(x))
    assert caller(2.0) == 6.0
    assert caller.signatures == [(types.float64,)]
    assert called.signatures == []
    assert called(2.0) == 3.0
    assert called.signatures == [(types.float64,)]
    # a user's own kernel takes the one behind the entry
    assert njit(lambda x: called(x) - 1.0)(5.0) == 5.0


def test_separate_kernels_are_linked_once_below_what_python_calls(monkeypatch):
    monkeypatch.setattr(jit, "CAN_KEEP", False)
    finished = []
    optimize = compiling.KernelLibrary._optimize_final_module

    def counted(self):
        optimize(self)
        bodies = [f.name for f in self._final_module.functions if not f.is_declaration]
        finished.append(sum("stands_alone" in name for name in bodies))

    monkeypatch.setattr(compiling.KernelLibrary, "_optimize_final_module", counted)

    def stands_alone(x):
        jit.keep_separate()
        return x * x

    called = jit.inner_jit(stands_alone)
    between = jit.inner_jit(lambda x: called(x) + called(2.0 * x))
    assert jit.jit(lambda x: between(x) + called(3.0 * x))(1.0) == 14.0
    # its code is in its own module alone while kernels are optimized
    assert finished == [1, 0, 0, 0]


def last(a, i):
    return a[i] + a[0]


def test_an_index_is_not_counted_from_the_end():
    a = np.array([1.0, 2.0, 4.0])
    assert njit(last)(a, -1) == 5.0
    assert njit(**OPTIONS)(last)(a, 2) == 5.0
    # What the next test relies on: checked bounds tell of it.
    with pytest.raises(IndexError):
        njit(boundscheck=True, **OPTIONS)(last)(a, -1)


CHECKED = """
import numba
from derail_ros import models
from derail_ros.scenario import list_scenarios, load_scenario_by_name
from tests.engine import campaign

assert numba.config.BOUNDSCHECK == 1
for info in list_scenarios():
    models.build(load_scenario_by_name(info.name).to_params()).advance_to(60.0)
for name in ("base_train", "cars_on_a_siding", "mississauga_wall"):
    spatial = load_scenario_by_name(name).with_overrides({"model": "spatial"})
    models.build(spatial.to_params()).advance_to(12.0)
for finding in campaign.campaign(0, 60):
    assert not finding.what or finding.what.startswith("refused"), finding.what
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_index_of_a_kernel_is_negative_or_too_large(tmp_path):
    environment = os.environ | {"NUMBA_BOUNDSCHECK": "1", "DERAIL_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", CHECKED], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert any(tmp_path.rglob("*.nbi")), "kernels of its own"
