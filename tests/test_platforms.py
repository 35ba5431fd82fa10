"""Windows and macOS as far as Linux can play them: what only POSIX or Linux has is neither imported nor called."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from polsep.capture.live import lower_priority
from polsep.compute import library, processor, threads, workers
from polsep.io.store.rows import read_cpu_times, read_peak_memory

ROOT = Path(__file__).resolve().parents[1]

#: Imports every module where neither modules nor functions of POSIX are.
IMPORT_ALL = """
import contextlib, importlib, os, pkgutil, signal, sys
for name in "numba scipy torch openvino OpenEXR PIL.Image imagecodecs tifffile trimesh embreex av gradio ray".split():
    with contextlib.suppress(ImportError):
        importlib.import_module(name)  # libraries have their own ways for each system
import polsep
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
for name in ("fork", "register_at_fork", "sched_getaffinity", "getpriority", "setpriority", "sysconf", "getuid"):
    delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGALRM", "setitimer", "pthread_sigmask"):
    delattr(signal, name)
missing = set()
for module in pkgutil.walk_packages(polsep.__path__, "polsep."):
    if module.name == "polsep.__main__" or "-" in module.name:
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        missing.add(str(error.name).partition(".")[0])
print(sorted(missing & {"fcntl", "grp", "pwd", "resource", "termios", "polsep"}))
"""


def test_every_module_imports_without_posix() -> None:
    """Modules of extras that are not installed are passed over; functions of POSIX are asked for where used."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", IMPORT_ALL], capture_output=True, text=True, timeout=300, cwd=ROOT
    )
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_facts_of_linux_are_unknown_elsewhere(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads, the processor, priorities and memory: a default, nothing, or what the system tells in its own unit."""
    is_file = Path.is_file
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(Path, "is_file", lambda path: not str(path).startswith("/proc") and is_file(path))
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delattr(os, "setpriority")
    processor.cpu_flags.cache_clear()
    library.open_library.cache_clear()
    try:
        assert processor.cpu_flags() == frozenset()
        with pytest.raises(library.Unusable, match=f"the library is for linux-x86_64-cpython, this is {system}"):
            library.open_library()
    finally:
        processor.cpu_flags.cache_clear()
        library.open_library.cache_clear()
    assert 1 <= threads._default_threads() <= (os.cpu_count() or 1)
    assert read_cpu_times() == (0.0, 0.0)
    assert (read_peak_memory() > 0) == (system == "darwin")
    workers.keep_memory()
    lower_priority()
