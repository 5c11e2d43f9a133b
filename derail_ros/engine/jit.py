"""Compilation of the kernels, with a cache that cannot serve stale physics.

numba decides by the file of a *caller* whether its cached machine code is fresh: a cached kernel
would go on using the old version of a law that lives in another file. Here the cache folder's name
holds a hash of every source file of the engine, the versions of numba and llvmlite, and the
features of the processor, so that any edit starts a new cache.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from stat import S_ISDIR
from typing import IO, Any

import llvmlite
import llvmlite.binding
import numba
from numba import config as numba_config
from numba.extending import intrinsic

from derail_ros.engine.compiling import KernelCompiler, forget_constants


def source_hash() -> str:
    """Hash of the engine's sources, the compiler's versions and the processor (16 hex digits)."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
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
CACHE_DIR, CAN_KEEP = _choose(cache_root() / f"{FOLDER_PREFIX}{source_hash()}")
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
    # numba reads the folder when the decorator runs, so the setting is changed only for that
    # long: a user's own numba functions keep their own cache.
    config: Any = numba_config
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(CACHE_DIR)
    options.update(cache=CAN_KEEP, nogil=True, fastmath=False, error_model="numpy")
    # Kernels own no array: without numba's runtime they do not count references to the dozens
    # that they hand on, which took 10 to 15 % of a run.
    options["_nrt"] = False
    options["pipeline_class"] = KernelCompiler
    try:
        return forget_constants(_save_in_turn(numba.njit(**options)(function)))
    finally:
        config.CACHE_DIR = previous


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel: no Python objects, no fast math, GIL released, cached on disk."""
    return _compile(function, no_cfunc_wrapper=True)


def inner_jit(function: Callable[..., Any]) -> Any:
    """The same for a kernel that only kernels call: without the costly Python entry."""
    return _compile(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)
