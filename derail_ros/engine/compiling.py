"""numba's compiler, with the answers to its questions about types remembered.

A third of the time that the kernels take to compile goes into one question: which of numba's
implementations of ``+`` or ``<`` or an index serves operands of these types? numba tries them one
after the other at each operation in each kernel, thousands of times the same two hundred
questions. Here each answer is kept.

And numba compiles a kernel anew for each constant that it is called with (``add_event`` for eight
kinds of event). Here a constant counts as any number of its type.

Neither changes what a kernel computes. Should numba's insides be others than what this file knows,
kernels are compiled as numba does it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import types
from numba.core.compiler import Compiler

_unliteral: Any = types.unliteral
_known: dict[Any, Any] = {}
_depth = 0


def _remembering(ask: Any) -> Any:
    """numba's look-up ``ask`` of an implementation, with a memory in front of it."""

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return ask(self, context, args, kws)
        # By identity: numba makes another object when an implementation is added.
        key = id(self), id(context), tuple(args)
        found = _known.get(key)
        if found is None:
            found = _known[key] = self, context, ask(self, context, args, kws)
        return found[2]

    return get_call_type


@contextmanager
def _remember() -> Iterator[None]:
    """Remember while kernels are compiled; numba's lock keeps other threads from compiling."""
    global _depth
    kind: Any = types.Function
    ask = getattr(kind, "get_call_type", None)
    if _depth or ask is None or "get_call_type" in vars(kind):
        yield
        return
    kind.get_call_type = _remembering(ask)
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        del kind.get_call_type
        _known.clear()


class KernelCompiler(Compiler):
    """Compiler of the kernels."""

    def compile_extra(self, func: Any) -> Any:
        compile_plainly: Any = super().compile_extra
        with _remember():
            return compile_plainly(func)


def forget_constants(kernel: Any) -> Any:
    """Let kernels that call this one share its code, whatever constants they call it with."""
    plain = getattr(kernel, "get_call_template", None)
    if plain is not None:

        def get_call_template(args: Any, kws: Any) -> Any:
            args = tuple(_unliteral(a) for a in args)
            return plain(args, {name: _unliteral(a) for name, a in kws.items()})

        kernel.get_call_template = get_call_template
    return kernel
