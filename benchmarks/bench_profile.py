"""Where the time of a run goes: a table in docs/performance.md.

``python bench_profile.py`` compiles the engine a second time, each kernel that stands by itself
wrapped in two readings of the processor's cycle counter, less those of what it calls. Kernels that
the compiler puts into their callers count with those. The instrumented run is the same run to the
bit; how much longer it takes is printed.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
RUNS = 15

PARTS = {
    "forces: strikers, knuckles, brakes, ground": (
        "coupler_forces", "brake_forces", "ground_forces",
    ),
    "contacts: pairs that may touch, gaps, corners": (
        "pair_contacts", "limit_way", "rebuild",
    ),
    "contacts: events, peaks within steps, memory of walls": (
        "track_contacts", "_note_force", "_peak_within", "_force_within", "remember_walls",
    ),
    "assembly: rows, factorization, velocity terms": (
        "accelerations", "truck_rows", "factor", "constraint_gamma",
    ),
    "solve": ("solve",),
    "projection onto the constraints": ("onto_constraints", "project_velocities"),
    "sines and cosines": ("angles",),
    "integrator: stages, error": ("take_stages", "step_error"),
    "implicit friction": ("friction_damping", "brake_damping", "ground_damping"),
    "moments inside a step: jumps, kinks, crossings": (
        "first_jump", "first_kink", "first_passing",
    ),
    "steps, derailments, events": (),
}  # fmt: skip
"""Part -> kernels; the last one has all others."""


class Counters:
    """Cycles and calls of each kernel, in memory that compiled code writes to."""

    def __init__(self) -> None:
        import numpy as np

        self.names: list[str] = []
        self.cells = np.zeros(401, dtype=np.int64)

    def instrument(self, compile_plain: Any) -> Any:
        """A compiler of kernels that wraps those which stay separate."""
        import numba
        from llvmlite import ir
        from numba.extending import intrinsic

        word = ir.IntType(64)
        address = self.cells.ctypes.data

        def place(builder: Any, index: Any) -> Any:
            offset = builder.mul(index, ir.Constant(word, 8))
            return builder.inttoptr(
                builder.add(ir.Constant(word, address), offset), word.as_pointer()
            )

        @intrinsic
        def cycles(typing: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                kind = ir.FunctionType(word, [])
                counter = builder.module.declare_intrinsic("llvm.readcyclecounter", fnty=kind)
                return builder.call(counter, [])

            return numba.types.int64(), code

        @intrinsic
        def peek(typing: Any, index: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                return builder.load(place(builder, args[0]))

            return numba.types.int64(numba.types.int64), code

        @intrinsic
        def poke(typing: Any, index: Any, value: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                builder.store(args[1], place(builder, args[0]))
                return context.get_dummy_value()

            return numba.types.void(numba.types.int64, numba.types.int64), code

        def compile_counted(function: Any, **options: Any) -> Any:
            kernel = compile_plain(function, **options)
            source = inspect.getsource(function)
            if "keep_separate()" not in source and function.__name__ != "advance":
                return kernel
            own, calls = 1 + 2 * len(self.names), 2 + 2 * len(self.names)
            self.names.append(function.__name__)

            def counted(*args):  # type: ignore[no-untyped-def]
                within = peek(0)  # cycles of what the caller has called so far
                poke(0, 0)
                spent = cycles()
                result = kernel(*args)
                spent = cycles() - spent
                poke(own, peek(own) + spent - peek(0))
                poke(calls, peek(calls) + 1)
                poke(0, within + spent)
                return result

            return compile_plain(counted, **{**options, "cache": False})

        return compile_counted

    def read(self) -> dict[str, tuple[int, int]]:
        """Name -> cycles, calls."""
        found: dict[str, tuple[int, int]] = {}
        for k, name in enumerate(self.names):
            spent, calls = found.get(name, (0, 0))
            found[name] = spent + int(self.cells[1 + 2 * k]), calls + int(self.cells[2 + 2 * k])
        return found


def engine_with(counters: Counters) -> None:
    """Import the engine with counting kernels; before anything else imports it."""
    found = importlib.util.find_spec("derail_ros")
    assert found is not None and found.origin is not None
    path = Path(found.origin).parent / "engine" / "jit.py"
    spec = importlib.util.spec_from_file_location("derail_ros.engine.jit", path)
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    sys.modules["derail_ros.engine.jit"] = module
    spec.loader.exec_module(module)
    module._compile = counters.instrument(module._compile)
    from derail_ros.engine import warming

    warming._ready.set()  # kernels with addresses of this process in them go into no shared cache


def best_run(name: str, counters: Counters | None = None) -> tuple[float, Any, Any]:
    """Least processor time of a run to rest, s, the run, and what the counters had after it."""
    from derail_ros.engine import PlanarSimulation
    from derail_ros.scenario import load_scenario_by_name

    params = load_scenario_by_name(name).to_params()
    PlanarSimulation(params).run()
    best, run, found = 1e9, None, None
    for _ in range(RUNS):
        run = PlanarSimulation(params)
        if counters is not None:
            counters.cells[:] = 0
        began = time.process_time()
        run.advance_to(float("inf"))
        spent = time.process_time() - began
        if spent < best:
            best = spent
            found = None if counters is None else counters.read()
    return best, run, found


def table(name: str) -> str:
    """The profile of a scenario as text for the page."""
    plain = subprocess.run(
        [sys.executable, __file__, "--plain", name], capture_output=True, text=True, check=True
    )
    plain_s, plain_hash = plain.stdout.split()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["DERAIL_CACHE_DIR"] = folder
        counters = Counters()
        engine_with(counters)
        spent, run, found = best_run(name, counters)
    if run.state_hash() != plain_hash:
        raise RuntimeError("the instrumented run is another one")
    total = sum(cycles for cycles, _ in found.values())
    named = {kernel for kernels in PARTS.values() for kernel in kernels}
    missing = named - set(found)
    if missing:
        raise RuntimeError(f"no such kernels: {', '.join(sorted(missing))}")
    evaluations = run.statistics["evaluations"]
    steps = run.statistics["steps"]
    lines = [
        f"`{name}` to rest, {evaluations} evaluations in {steps} steps: {float(plain_s):.3f} s, "
        f"with counters {spent:.3f} s. Shares of the cycles counted:",
        "",
        "| part | share | µs a step | kernels |",
        "| --- | --- | --- | --- |",
    ]
    for part, kernels in PARTS.items():
        chosen = kernels or tuple(sorted(set(found) - named, key=lambda k: -found[k][0]))
        cycles = sum(found[kernel][0] for kernel in chosen)
        share = cycles / total
        shown = [k for k in chosen if found[k][0] > 0.003 * total]
        lines.append(
            f"| {part} | {share:.0%} | {1e6 * float(plain_s) * share / steps:.1f} "
            f"| {', '.join(f'`{k}`' for k in shown)} |"
        )
    return "\n".join(lines)


def main() -> None:
    if "--plain" in sys.argv:
        spent, run, _ = best_run(sys.argv[-1])
        print(spent, run.state_hash())
        return
    text = table("mississauga_published")
    print(text)
    page = PAGE.read_text(encoding="utf-8")
    marks = r"(<!-- profile: begin -->\n).*?(\n<!-- profile: end -->)"
    page, found = re.subn(marks, lambda m: f"{m[1]}\n{text}\n{m[2]}", page, flags=re.DOTALL)
    assert found == 1, "the page has no place for the profile"
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
