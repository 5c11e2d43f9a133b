"""numba's compiler, with less to do.

A third of the time that the kernels take to compile goes into one question: which of numba's
implementations of ``+`` or ``<`` or an index serves operands of these types? numba tries them one
after the other at each operation in each kernel, thousands of times the same two hundred
questions. Here each answer is kept.

And numba compiles a kernel anew for each constant that it is called with (``add_event`` for eight
kinds of event). Here a constant counts as any number of its type.

And numba puts the code of all that a kernel calls into the kernel's own, optimizes the whole once
more, and makes machine code of it: of a kernel five calls down five times. Here a kernel is
optimized once, one that stands by itself (``jit.keep_separate``) is put into its caller's code
after that has been optimized, and only what Python calls becomes machine code, with all that it
calls.

And numba asks at each index whether it is negative, to count it from the end: a sixteenth of a
run. In kernels no index is negative (``tests/engine/test_compiling.py`` runs them with bounds
checked).

None of this changes what a kernel computes. Where numba's code is another than this file knows, it
is left as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import llvmlite.binding
from numba.core import errors, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import require_global_compiler_lock
from numba.np import arrayobj

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


class _NoColors:
    """Message texts as they are. numba colors one at each instruction, in case it should fail."""

    def __getattr__(self, name: str) -> Any:
        return str


def _from_zero(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """An index as it is, in numba's words."""
    return context.cast(builder, index, kind, types.intp)


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
    colors = getattr(errors, "_termcolor_inst", None)
    errors._termcolor_inst = _NoColors()
    indexing: Any = arrayobj
    fix = getattr(indexing, "fix_integer_index", None)
    indexing.fix_integer_index = _from_zero
    try:
        yield
    finally:
        _depth -= 1
        errors._termcolor_inst = colors
        indexing.fix_integer_index = fix
        del kind.get_call_type
        _known.clear()


class _Unused:
    """The code generator, for a library that becomes no machine code of its own."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, env: Any) -> None:
        """Kernels without Python objects use no environment."""


class KernelLibrary(JITCodeLibrary):
    """The code of a kernel: its own, and apart from it that of separate kernels it calls.

    Attributes
    ----------
    emit : it becomes machine code, for Python calls it
    own : its optimized code with what has been inlined, to be linked with callers
    separate : it must not be inlined
    called : the separate kernels that it calls and that those call, callees first
    """

    def __init__(self, codegen: Any, name: str, emit: bool) -> None:
        super().__init__(codegen, name)
        self.emit = emit
        self.own: Any = None
        self.separate = False
        self.called: dict[KernelLibrary, None] = {}

    @property
    def codegen(self) -> Any:
        """The code generator, for numba's dispatchers."""
        return self._codegen if self.emit else _Unused(self._codegen)

    def add_ir_module(self, ir_module: Any) -> None:
        """Take over the code of a function, in numba's words."""
        if any("noinline" in function.attributes for function in ir_module.functions):
            self.separate = True
        super().add_ir_module(ir_module)

    def _optimize_functions(self, ll_module: Any) -> None:
        """Not function by function first: the whole kernel is optimized below."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Once; numba does it twice, to remove counts of references that kernels do not keep."""
        manager, builder = self._codegen._module_pass_manager()
        manager.run(self._final_module, builder)

    def finalize(self) -> None:
        """Optimize, then link what is called."""
        require_global_compiler_lock()
        self._raise_if_finalized()
        module = self._final_module
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            if not isinstance(library, KernelLibrary):
                module.link_in(library._get_module_for_linking(), preserve=True)
                continue
            self.called.update(library.called)
            if library.separate:
                self.called[library] = None
            else:
                module.link_in(library.own, preserve=True)
        self._optimize_final_module()
        self.own = module.clone()
        for function in self.own.functions:
            if not function.is_declaration and function.linkage.name == "external":
                function.linkage = "linkonce_odr"
        if self.emit:
            self._link_called(module)
            module.verify()
            self._finalize_final_module()
        else:
            self._finalize_dynamic_globals()
            self._finalized = True

    def _link_called(self, module: Any) -> None:
        """Callers first: what nothing refers to yet is left out."""
        for library in reversed(self.called):
            module.link_in(library.own, preserve=True)

    def _get_module_for_linking(self) -> Any:
        """All of it, for libraries that are not of this kind."""
        self._ensure_finalized()
        if self._shared_module is None:
            self._shared_module = self.own.clone()
            self._link_called(self._shared_module)
        return self._shared_module

    def serialize_using_object_code(self) -> Any:
        """For the cache: machine code, and of the code to link only the names.

        No kernel links an entry (``jit.jit``).
        """
        self._ensure_finalized()
        names = [
            f'define void @"{function.name}"() {{ ret void }}'
            for function in self._final_module.functions
            if not function.is_declaration and function.linkage.name == "external"
        ]
        named = llvmlite.binding.parse_assembly("\n".join(names)).as_bitcode()
        return self.name, "object", (self._get_compiled_object(), named)


class KernelCompiler(Compiler):
    """Compiler of the kernels."""

    def compile_extra(self, func: Any) -> Any:
        state = self.state
        if state.library is None:
            state.library = KernelLibrary(
                state.targetctx.codegen(), func.__qualname__, not state.flags.no_cpython_wrapper
            )
            state.library.enable_object_caching()
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
