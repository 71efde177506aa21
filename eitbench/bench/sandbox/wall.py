"""Limits that a process puts on itself before it runs somebody else's code, and cannot lift again.

Files: Linux' Landlock (kernel 5.13 and later). Whatever is not named is out of reach, other
processes' memory too, and TCP where the kernel knows how to refuse it. Linux' seccomp: all system
calls but those that estimators need. Memory: a limit of the address space.
"""

from __future__ import annotations

import ctypes
import os
import site
import sys
from collections.abc import Iterable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from eitbench._files import PACKAGE
from eitbench.bench.sandbox import calls
from eitbench.bench.sandbox.keeper import Limits

_CREATE, _ADD, _RESTRICT = 444, 445, 446
"""System calls of Landlock, the same on every architecture that Python is at home on."""
_READ = 1 << 0 | 1 << 2 | 1 << 3
"""execute, read a file, list a folder"""
_FILE = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14
"""What rules on a single file may allow."""
_ALL = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
"""What a version of the interface can refuse: all that came with it or earlier."""
_NO_NEW_PRIVILEGES, _FILTER_CALLS = 38, (22, 2)
_SETTINGS = ("ld.so.cache", "localtime", "timezone", "passwd", "group", "nsswitch.conf",
             "mime.types", "os-release", "fonts", "alternatives")
"""What programs look up in /etc; much else there is not for everybody."""

_DESCRIPTORS = 1024
"""open files of a process; each pipe holds memory that is nobody's"""
_OWN_COUNT = [5, 14]
"""From this Linux on a namespace of users has a count of processes of its own."""
_OFFERS = ("eitbench.worlds", "eitbench.methods", "eitbench.scores", "eitbench.loaders")
"""Groups of entry points by which installed packages offer something to this one."""


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("network", ctypes.c_uint64),
                ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("allowed", ctypes.c_uint64), ("folder", ctypes.c_int32))


class _Step(ctypes.Structure):
    _fields_ = (("deed", ctypes.c_uint16), ("skip_if", ctypes.c_uint8),
                ("skip_else", ctypes.c_uint8), ("value", ctypes.c_uint32))


class _Filter(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("steps", ctypes.POINTER(_Step)))


def landlock_version() -> int:
    """Version of the kernel's interface; 0 where there is none."""
    if not sys.platform.startswith("linux"):
        return 0
    return max(0, int(_libc().syscall(_CREATE, None, 0, 1)))


def close_files(readable: Iterable[Path], writable: Iterable[Path]) -> bool:
    """From now on this process and its children reach only these files and folders, and what lies
    beneath them.

    Returns whether that is so; False where the kernel has no Landlock. Raises ``OSError`` if it has
    and refuses.
    """
    version = landlock_version()
    if not version:
        return False
    libc = _libc()
    everything = _ALL[max(known for known in _ALL if known <= version)]
    asked = _Ruleset(everything, 0b11 if version >= 4 else 0, 0b11 if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = _checked(libc.syscall(_CREATE, ctypes.byref(asked), size, 0))
    for paths, access in ((readable, _READ), (writable, everything)):
        for path in paths:
            if not path.exists():
                continue
            place = os.open(path, os.O_PATH)
            allowed = (access if path.is_dir() else access & _FILE) & everything
            rule = _Beneath(allowed, place)
            _checked(libc.syscall(_ADD, ruleset, 1, ctypes.byref(rule), 0))
            os.close(place)
    _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    _checked(libc.syscall(_RESTRICT, ruleset, 0))
    os.close(ruleset)
    return True


def refuse_calls(signals: bool) -> bool:
    """From now on this process and its children make only the system calls that
    `eitbench.bench.sandbox.calls` names.

    ``signals``: whether those they send reach their own kin only. Returns whether that is so; False
    where the kernel cannot filter system calls or their numbers are not known.
    """
    machine = os.uname().machine if sys.platform.startswith("linux") else ""
    if machine not in calls.MACHINES:
        return False
    steps = calls.steps(machine, os.getpid(), signals)
    libc = _libc()
    content = (_Step * len(steps))(*(_Step(*step) for step in steps))
    _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    return bool(libc.prctl(*_FILTER_CALLS, ctypes.byref(_Filter(len(steps), content)), 0, 0) == 0)


def limit(limits: Limits, counts_apart: bool) -> None:
    """What the kernel itself sees to: no more bytes of address space and in a file than that, not
    many files open at once, no core dumps; a request beyond raises ``MemoryError`` or ``OSError``.

    ``counts_apart``: whether it is in a namespace of users, whose processes newer kernels count by
    themselves, but for root's. Elsewhere all processes of the user would count.
    """
    import resource  # not on Windows
    most = {resource.RLIMIT_AS: limits.memory, resource.RLIMIT_FSIZE: limits.disk,
            resource.RLIMIT_NOFILE: _DESCRIPTORS, resource.RLIMIT_CORE: 0}
    if counts_apart and _kernel() >= _OWN_COUNT:
        most[resource.RLIMIT_NPROC] = limits.tasks
    for what, number in most.items():
        resource.setrlimit(what, (number, number))


def _kernel() -> list[int]:
    """Its version, as far as it is numbers."""
    return [int(part) for part in os.uname().release.split("-")[0].split(".") if part.isdecimal()]


def drop_capabilities() -> bool:
    """From now on root may do no more than others, nor who has namespaces; whether it is so."""
    if not sys.platform.startswith("linux"):
        return False
    asked = (ctypes.c_uint32 * 2)(0x20080522, 0)
    none = (ctypes.c_uint32 * 6)()
    return bool(_libc().capset(asked, none) == 0)


def own_number() -> int:
    """Of this process, as those outside count it."""
    return int(os.readlink("/proc/self")) if Path("/proc/self").exists() else os.getpid()


def python_files() -> list[Path]:
    """What Python and this package need to read: programs, libraries, this process' own entries and
    the processor's."""
    package = PACKAGE
    # else others lie beside
    is_checkout = (package.parent / "pyproject.toml").exists()
    places = [sys.prefix, sys.base_prefix, sys.exec_prefix,
              str(package), str(package.parent / "baselines"), "/usr", "/lib", "/lib64", "/bin",
              *(f"/etc/{name}" for name in _SETTINGS), "/dev/null", "/dev/urandom", "/dev/zero",
              f"/proc/{own_number()}", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat",
              "/sys/devices/system/cpu",
              *([] if is_checkout else [str(package.parent)]), *_installed()]
    return [Path(place) for place in places]


def _installed() -> list[str]:
    """Where packages are installed for this Python, other environments' folders on `sys.path` among
    them, and the packages that offer something to this one; not whatever else lies on `sys.path`,
    as checkouts installed for editing."""
    others = [place for place in sys.path if Path(place).name in ("site-packages", "dist-packages")]
    places = [*site.getsitepackages(), site.getusersitepackages(), *others]
    offers = [point for group in _OFFERS for point in entry_points(group=group)]
    for package in {point.module.partition(".")[0] for point in offers}:
        found = find_spec(package)
        if found is not None:
            places += found.submodule_search_locations or [found.origin or ""]
    return [place for place in places if place]


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"a limit of this process: {os.strerror(code)}")
    return result
