"""Limits that a process puts on itself before it runs somebody else's code, and cannot lift again.

Files: Linux' Landlock (kernel 5.13 and later). Whatever is not named is out of reach, other
processes' memory too, and TCP where the kernel knows how to refuse it. Linux' seccomp: sockets of
all kinds, and what Landlock lets pass, such as being told the names of files that others open.
Memory: a limit of the address space.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from eitbench._files import PACKAGE

_CREATE, _ADD, _RESTRICT = 444, 445, 446
"""System calls of Landlock, the same on every architecture that Python is at home on."""
_READ = 1 << 0 | 1 << 2 | 1 << 3
"""execute, read a file, list a folder"""
_FILE = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14
"""What rules on a single file may allow."""
_ALL = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
"""What a version of the interface can refuse: all that came with it or earlier."""
_NO_NEW_PRIVILEGES, _FILTER_CALLS = 38, (22, 2)
_REFUSED_CALLS = {
    "x86_64": (0xC000003E, 302, (
        41, 53, 425,  # socket, socketpair, io_uring_setup
        109, 112,                                                     # setpgid, setsid
        253, 294, 254, 300, 301, 303, 304,  # inotify, fanotify, files by their handles
        90, 91, 268, 452, 92, 93, 94, 260,                            # chmod and chown
        132, 235, 261, 280, 188, 189, 190, 463, 197, 198, 199, 466,  # utime and extended attributes
        101, 310, 311, 298, 321,  # ptrace, others' memory, perf events, bpf
        141, 142, 144, 314, 251, 203)),  # priorities and processors, of others too
    "aarch64": (0xC00000B7, 261, (
        198, 199, 425, 154, 157, 26, 27, 262, 263, 264, 265, 52, 53, 452, 54, 55,
        88, 5, 6, 7, 463, 14, 15, 16, 466, 117, 270, 271, 241, 280, 140, 118, 119, 274, 30, 122)),
}
"""Architecture as the kernel names it, the number of its call prlimit64, which may ask about the
process itself, and those of the calls that are refused; the second in the order of the first, which
has more of its own."""
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
"""What a step of a filter of system calls does."""
_ALLOWED, _REFUSED = 0x7FFF0000, 0x00050000 | errno.EACCES
_CALL, _ARCHITECTURE, _ARGUMENT = 0, 4, 16
"""Where a filter finds them, and the lower half of the first argument."""
_FOREIGN = 0x40000000
"""From here on calls have x86_64's other numbers, for 32-bit pointers."""


_SETTINGS = ("ld.so.cache", "localtime", "timezone", "passwd", "group", "nsswitch.conf",
             "mime.types", "os-release", "fonts", "alternatives")
"""What programs look up in /etc; much else there is not for everybody."""


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


def refuse_calls(signals: bool = True) -> bool:
    """From now on this process and its children make no socket of any kind, leave neither session
    nor group, and are not told which files others open; owners, modes, times and attributes of
    files stay what they are, and so do priorities and limits of other processes.

    Pairs of sockets are refused too, as one of datagrams can be turned to any address. Returns
    whether that is so; False where the kernel cannot filter system calls or this does not know
    their numbers.
    """
    if not sys.platform.startswith("linux") or os.uname().machine not in _REFUSED_CALLS:
        return False
    architecture, limits, calls = _REFUSED_CALLS[os.uname().machine]
    asked = [(_AT_LEAST, _FOREIGN), *((_EQUAL, call) for call in calls)]
    # limits of process 0: its own
    last = [(_EQUAL, 0, 2, limits), (_LOAD, 0, 0, _ARGUMENT), (_EQUAL, 0, 1, 0),
            (_RETURN, 0, 0, _ALLOWED), (_RETURN, 0, 0, _REFUSED)]
    steps = [(_LOAD, 0, 0, _ARCHITECTURE), (_EQUAL, 1, 0, architecture), (_RETURN, 0, 0, _REFUSED),
             (_LOAD, 0, 0, _CALL),
             *((deed, len(asked) - i + len(last) - 2, 0, value)
               for i, (deed, value) in enumerate(asked)), *last]
    libc = _libc()
    content = (_Step * len(steps))(*(_Step(*step) for step in steps))
    _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    return bool(libc.prctl(*_FILTER_CALLS, ctypes.byref(_Filter(len(steps), content)), 0, 0) == 0)


def limit_memory(size: int) -> None:
    """No more than ``size`` bytes of address space, no core dumps; a request beyond raises
    ``MemoryError``."""
    import resource  # not on Windows
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


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
    checkout = package.parent if (package.parent / "pyproject.toml").exists() else None
    places = [sys.prefix, sys.base_prefix, sys.exec_prefix,
              str(package), str(package.parent / "baselines"), "/usr", "/lib", "/lib64", "/bin",
              *(f"/etc/{name}" for name in _SETTINGS), "/dev/null", "/dev/urandom", "/dev/zero",
              f"/proc/{own_number()}", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat",
              "/sys/devices/system/cpu",
              *(place for place in sys.path if place and Path(place) != checkout)]
    return [Path(place) for place in places]


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"a limit of this process: {os.strerror(code)}")
    return result
