"""C that CasADi generated, compiled once and kept in the user's cache.

A library's name is the hash of all that it is made from, so that a changed robot gets another one and an old one is
found again, and the hash of what it is, so that a damaged one isn't loaded: that would end the process. Two processes
may compile the same at once: each writes under a name of its own and renames.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

FLAGS = ("-O1", "-fPIC", "-shared")  # -O2 takes several times as long to compile and wins little
TIMEOUT = 600  # [s] a compiler that takes longer is given up


class CompilerError(RuntimeError):
    """There is no compiler, or it failed; one line says which."""


def cache_folder():
    """Where libraries are kept: `apg-adapt` in $XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "apg-adapt"


def find_compiler():
    """The C compiler: $CC, gcc, cc or clang.

    Raises:
        CompilerError: none is installed.
    """
    wanted = [name for name in (os.environ.get("CC"), "gcc", "cc", "clang") if name]
    for name in wanted:
        if path := shutil.which(name):
            return path
    raise CompilerError(f"no C compiler found (tried {', '.join(wanted)})")


def shared_library(source):
    """The file of the shared library of a C text; compiled unless it is in the cache.

    Raises:
        CompilerError: no compiler, a compiler that fails, or a cache that can't be written.
    """
    compiler = find_compiler()
    key = _hash("\n".join((compiler, *FLAGS, platform.platform(), source)).encode())
    folder = cache_folder()
    try:
        for library in folder.glob(f"{key}-*.so"):
            if library.stem == f"{key}-{_hash(library.read_bytes())}":
                return library
            library.unlink(missing_ok=True)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            library = _compile(compiler, source, Path(own))
            return library.replace(folder / f"{key}-{_hash(library.read_bytes())}.so")
    except OSError as error:
        raise CompilerError(f"{folder}: {error.strerror or error}") from None


def _hash(content):
    return hashlib.sha256(content).hexdigest()[:32]


def _compile(compiler, source, folder):
    """The library of a C text, in a folder."""
    code, library = folder / "functions.c", folder / "functions.so"
    code.write_text(source, encoding="utf-8")
    command = [compiler, *FLAGS, "-o", str(library), str(code), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        raise CompilerError(f"{compiler} took more than {TIMEOUT} s") from None
    if done.returncode or not library.exists():
        said = (done.stderr.strip() or "no message").splitlines()[0]
        raise CompilerError(f"{compiler} failed with status {done.returncode}: {said}")
    return library
