"""Compilation of the kernels, with a cache that cannot serve stale physics.

numba decides by the file of a *caller* whether its cached machine code is fresh: a cached kernel
would go on using the old version of a law that lives in another file. Here the cache folder's name
holds a hash of every source file of the engine, the versions of numba and llvmlite, and the
features of the processor, so that any edit starts a new cache.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
import tempfile
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from stat import S_ISDIR
from typing import IO, Any

import llvmlite
import llvmlite.binding
import numba
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

from derail_ros.engine.compiling import KernelCompiler, forget_constants


def source_hash() -> str:
    """Hash of the engine's sources (16 hex digits), equal on all machines."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def kernels_hash() -> str:
    """Hash of the sources, the compiler's versions and the processor (16 hex digits).

    Equal hashes compute equal bits.
    """
    digest = hashlib.sha256(source_hash().encode())
    for part in (
        numba.__version__,
        llvmlite.__version__,
        sys.implementation.cache_tag,
        llvmlite.binding.get_host_cpu_name(),
        llvmlite.binding.get_host_cpu_features().flatten(),
    ):
        digest.update(str(part).encode() + b"\0")
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Folder that holds the caches: ``DERAIL_CACHE_DIR``, or the user's cache folder."""
    explicit = os.environ.get("DERAIL_CACHE_DIR")
    if explicit:
        return Path(explicit)
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "derail_ros"


def _made(folder: Path, private: bool = False) -> bool:
    """Make the folder; whether it can be written (and, if ``private``, by this user alone)."""
    try:
        if private:
            # What is in it will be run: in a place where anybody may write it must be ours.
            folder.parent.mkdir(mode=0o700, exist_ok=True)
            found = folder.parent.lstat()
            if found.st_uid != os.getuid() or not S_ISDIR(found.st_mode) or found.st_mode & 0o022:
                return False
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _choose(wanted: Path) -> tuple[Path, bool]:
    """The folder for the kernels, a temporary one if need be; whether it can be written."""
    if _made(wanted):
        return wanted, True
    try:
        spare = Path(tempfile.gettempdir()) / f"derail_ros-{os.getuid()}" / wanted.name
    except (OSError, AttributeError):  # nowhere at all; no such thing as a user's number
        return wanted, False
    return (spare, True) if _made(spare, private=True) else (wanted, False)


FOLDER_PREFIX = "kernels-"
CACHE_DIR, CAN_KEEP = _choose(cache_root() / f"{FOLDER_PREFIX}{kernels_hash()}")
"""Folder of this version's compiled kernels, and whether they can be kept there."""


def lock(file: IO[bytes], shared: bool, wait: bool) -> bool:
    """Take a lock on an open file; False when it is held and ``wait`` is not."""
    if sys.platform == "win32":  # no lock there: processes may compile side by side
        return True
    import fcntl

    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, how if wait else how | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


class _Locator:
    """Where numba keeps a kernel: by the name of its module, and fresh while its file is the same.

    numba's own locators go by the path of the file and its time. The same engine in another
    environment, or checked out once more, would compile everything anew beside a complete cache.
    """

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._folder = str(CACHE_DIR / function.__module__)
        self._line = function.__code__.co_firstlineno
        self._stamp = hashlib.sha256(Path(path).read_bytes()).hexdigest()

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> _Locator | None:
        """The place of a kernel; None for one that has no file."""
        return cls(function, path) if os.path.isfile(path) else None

    def ensure_cache_path(self) -> None:
        os.makedirs(self._folder, exist_ok=True)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


def _save_in_turn(kernel: Any) -> Any:
    """Let one process at a time write the cache.

    numba reads a kernel's index, picks the next free file name, and writes the index anew: of two
    processes with different signatures one could find its name on the other's code.
    """
    cache: Any = getattr(kernel, "_cache", None)
    save = getattr(cache, "save_overload", None)
    if CAN_KEEP and save is not None:

        def save_overload(signature: Any, data: Any) -> None:
            try:
                with open(CACHE_DIR / "saving", "ab") as file:
                    lock(file, shared=False, wait=True)
                    save(signature, data)
            except OSError:  # the folder is gone or the disk full: the kernel works without
                pass

        cache.save_overload = save_overload
    return kernel


def _keep_separate(typing_context: Any) -> Any:  # runs in the compiler
    """Statement for the beginning of a large kernel: LLVM shall not inline it into its callers.

    Without it every level of the call tree optimizes all that lies below it once more, and the
    first compilation takes several times as long.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return numba.types.void(), codegen


keep_separate: Any = intrinsic(_keep_separate)


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    # numba looks for a place when the decorator runs, so ours is known only for that long: a
    # user's own numba functions keep their own cache.
    impl: Any = FunctionCache._impl_class
    previous = impl._locator_classes
    impl._locator_classes = [_Locator]
    options = {"cache": CAN_KEEP, "nogil": True, "error_model": "numpy", **options}
    # Kernels own no array: without numba's runtime they do not count references to the dozens
    # that they hand on, which took 10 to 15 % of a run.
    options["_nrt"] = False
    options["pipeline_class"] = KernelCompiler
    try:
        return forget_constants(_save_in_turn(numba.njit(**options)(function)))
    finally:
        impl._locator_classes = previous


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel: no Python objects, no fast math, GIL released.

    What Python calls is an entry of its own, compiled when Python first calls it and cached on
    disk; kernels that call this one have no need of it.
    """
    kernel = inner_jit(function)
    if kernel is function:  # numba is switched off
        return kernel
    entry = _compile(_entry(kernel, function), no_cfunc_wrapper=True)
    for name in ("get_call_template", "get_overload", "get_compile_result"):
        setattr(entry, name, getattr(kernel, name))
    return entry


def _entry(kernel: Any, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that calls the kernel of ``function``; to the cache it is that function."""
    names = ", ".join(inspect.signature(function).parameters)
    space: dict[str, Any] = {"kernel": kernel}
    exec(f"def entry({names}):\n    return kernel({names})\n", space)
    code = function.__code__
    space["entry"].__code__ = space["entry"].__code__.replace(
        co_filename=code.co_filename, co_firstlineno=code.co_firstlineno
    )
    return wraps(function)(space["entry"])


def inner_jit(function: Callable[..., Any]) -> Any:
    """The same for a kernel that only kernels call: no Python entry, kept with its callers."""
    return _compile(function, cache=False, no_cpython_wrapper=True, no_cfunc_wrapper=True)
