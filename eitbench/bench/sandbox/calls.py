"""The system calls that a guest may make; `eitbench.bench.sandbox.wall` refuses all others.

Each by its name and its numbers on x86_64 and on aarch64, which lacks some old ones. All that has
no place here is refused: sockets, shared memory and messages of System V and POSIX, keyrings,
tracing, other processes' memory, mounts, namespaces, modules, io_uring, bpf, userfaultfd,
performance counters, modes, owners, times and attributes of files, priorities, sessions, being told
what others do.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable

_MEMORY = """
read 0 63, write 1 64, futex 202 98, mmap 9 222, munmap 11 215, mprotect 10 226, brk 12 214,
madvise 28 233, mremap 25 216, msync 26 227, mlock 149 228, munlock 150 229, mbind 237 235,
get_mempolicy 239 236, set_mempolicy 238 237, membarrier 324 283, pkey_alloc 330 289,
pkey_free 331 290, pkey_mprotect 329 288, map_shadow_stack 453 453
"""
"""Numbers in and out, and memory."""
_FILES = """
close 3 57, lseek 8 62, openat 257 56, openat2 437 437, open 2 -, creat 85 -, newfstatat 262 79,
fstat 5 80, stat 4 -, lstat 6 -, statx 332 291, access 21 -, faccessat 269 48,
faccessat2 439 439, readlink 89 -, readlinkat 267 78, getdents64 217 61, getdents 78 -,
getcwd 79 17, chdir 80 49, fchdir 81 50, pread64 17 67, pwrite64 18 68, readv 19 65,
writev 20 66, preadv 295 69, pwritev 296 70, preadv2 327 286, pwritev2 328 287, sendfile 40 71,
copy_file_range 326 285, dup 32 23, dup2 33 -, dup3 292 24, pipe 22 -, pipe2 293 59, mkdir 83 -,
mkdirat 258 34, rmdir 84 -, unlink 87 -, unlinkat 263 35, rename 82 -, renameat 264 38,
renameat2 316 276, link 86 -, linkat 265 37, symlink 88 -, symlinkat 266 36, mknod 133 -,
mknodat 259 33, truncate 76 45, ftruncate 77 46, fallocate 285 47, fsync 74 82, fdatasync 75 83,
fadvise64 221 223, flock 73 32, statfs 137 43, fstatfs 138 44, umask 95 166, getxattr 191 8,
lgetxattr 192 9, fgetxattr 193 10, listxattr 194 11, llistxattr 195 12, flistxattr 196 13,
close_range 436 436
"""
"""Files, as far as Landlock lets it."""
_WAITING = """
poll 7 -, ppoll 271 73, select 23 -, pselect6 270 72, epoll_create 213 -, epoll_create1 291 20,
epoll_ctl 233 21, epoll_wait 232 -, epoll_pwait 281 22, epoll_pwait2 441 441, eventfd 284 -,
eventfd2 290 19, signalfd4 289 74, timerfd_create 283 85, timerfd_settime 286 86,
timerfd_gettime 287 87, timer_create 222 107, timer_settime 223 110, timer_gettime 224 108,
timer_getoverrun 225 109, timer_delete 226 111, nanosleep 35 101, clock_nanosleep 230 115,
pause 34 -, alarm 37 -, getitimer 36 102, setitimer 38 103, restart_syscall 219 128,
sched_yield 24 124
"""
"""Waiting and clocks of its own."""
_CHILDREN = """
fork 57 -, vfork 58 -, execve 59 221, exit 60 93, exit_group 231 94, wait4 61 260,
waitid 247 95, set_tid_address 218 96, set_robust_list 273 99, get_robust_list 274 100,
rseq 334 293, arch_prctl 158 -, rt_sigaction 13 134, rt_sigprocmask 14 135, rt_sigreturn 15 139,
rt_sigpending 127 136, rt_sigsuspend 130 133, rt_sigtimedwait 128 137, sigaltstack 131 132
"""
"""Threads, children, and signals to itself."""
_QUESTIONS = """
getpid 39 172, gettid 186 178, getppid 110 173, getpgid 121 155, getpgrp 111 -, getsid 124 156,
getuid 102 174, geteuid 107 175, getgid 104 176, getegid 108 177, getresuid 118 148,
getresgid 120 150, getgroups 115 158, capget 125 90, getrlimit 97 163, setrlimit 160 164,
getrusage 98 165, getpriority 140 141, times 100 153, time 201 -, gettimeofday 96 169,
clock_gettime 228 113, clock_getres 229 114, sysinfo 99 179, uname 63 160, getcpu 309 168,
getrandom 318 278, sched_getaffinity 204 123, sched_getparam 143 121,
sched_getscheduler 145 120, sched_get_priority_max 146 125, sched_get_priority_min 147 126,
sched_rr_get_interval 148 127
"""
"""Questions about itself and the machine."""
_BY_ARGUMENTS = """
clone 56 220, clone3 435 435, prctl 157 167, prlimit64 302 261, ioctl 16 29, fcntl 72 25,
kill 62 129, tkill 200 130, tgkill 234 131
"""
"""Allowed with some arguments only, or with a refusal of their own."""
_NAMESPACES = 0x7E020000 | 0x8000
"""What `clone` must not be asked for: namespaces, and children that are the parent's."""
_PROCESS_OPTIONS = (2, 3, 15, 16, 23, 38, 39, 41, 42, 0x53564D41)
"""What `prctl` may be asked for: whether it ends with its parent and whether others may see
into it, not to change that; names of threads and memory, capabilities, privileges, huge pages."""
_DEVICE_QUESTIONS = (0x5401, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451, 0x802C542A, 0x40049409)
"""What `ioctl` may be asked for: whether it is a terminal and how wide, how much can be read, not
to wait, to be closed in a new program or not, to copy by reference."""
_FILE_QUESTIONS = (0, 1, 2, 3, 4, 5, 6, 7, 36, 37, 38, 1030, 1031, 1032)
"""What `fcntl` may be asked for: copies, flags and locks of open files, sizes of pipes; not to be
told what others do with them, nor to have signals sent."""


_GROUPS = (_MEMORY, _FILES, _WAITING, _CHILDREN, _QUESTIONS, _BY_ARGUMENTS)
_LOAD, _EQUAL, _AT_LEAST, _ANY_OF, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
"""What a step of a filter does."""
_ALLOWED, _REFUSED, _UNKNOWN = 0x7FFF0000, 0x00050000 | errno.EACCES, 0x00050000 | errno.ENOSYS
"""What it may answer; a C library has another way where a call is unknown."""
_CALL, _ARCHITECTURE, _ARGUMENTS = 0, 4, (16, 24)
"""Where a filter finds them, and the lower halves of the first arguments."""
_FOREIGN = 0x40000000
"""From here on calls have x86_64's other numbers, for 32-bit pointers."""
_RECENT = 424
"""From here on a C library asks whether the kernel knows a call."""
MACHINES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""As the kernel names them, and where their numbers stand here."""
Step = tuple[int, int, int, int]
"""What to do, how many steps to skip if so and else, a value."""


def steps(machine: str, process: int, signals: bool) -> list[Step]:
    """The filter for this machine; ``signals``: whether it may send any, because they reach none
    but its own children. Else it may send them to itself only, the ``process``."""
    known = numbers(machine)
    special = set(numbers(machine, (_BY_ARGUMENTS,)))
    says = [_answer(_ALLOWED)]
    by_argument = {
        "clone": [_load(0), (_ANY_OF, 0, 1, _NAMESPACES), _answer(_REFUSED), *says],
        "clone3": [_answer(_UNKNOWN)],  # its arguments lie where a filter cannot look
        "prctl": _one_of(0, _PROCESS_OPTIONS),
        "prlimit64": _one_of(0, [0]),  # of itself
        "ioctl": _one_of(1, _DEVICE_QUESTIONS),
        "fcntl": _one_of(1, _FILE_QUESTIONS),
        "kill": says if signals else [_answer(_REFUSED)],
        "tkill": says if signals else [_answer(_REFUSED)],
        "tgkill": says if signals else _one_of(0, [process]),
    }
    found: list[Step] = [
        (_LOAD, 0, 0, _ARCHITECTURE), (_EQUAL, 1, 0, MACHINES[machine][0]), _answer(_REFUSED),
        (_LOAD, 0, 0, _CALL), (_AT_LEAST, 0, 1, _FOREIGN), _answer(_REFUSED)]
    for name, number in known.items():
        then = by_argument[name] if name in special else says
        found += [(_EQUAL, 0, len(then), number), *then]
    return [*found, (_AT_LEAST, 0, 1, _RECENT), _answer(_UNKNOWN), _answer(_REFUSED)]


def _one_of(argument: int, values: Iterable[int]) -> list[Step]:
    """Allowed if an argument is one of these."""
    found = [_load(argument)]
    for value in values:
        found += [(_EQUAL, 0, 1, value), _answer(_ALLOWED)]
    return [*found, _answer(_REFUSED)]


def _load(argument: int) -> Step:
    return _LOAD, 0, 0, _ARGUMENTS[argument]


def _answer(answer: int) -> Step:
    return _RETURN, 0, 0, answer


def numbers(machine: str, groups: Iterable[str] = _GROUPS) -> dict[str, int]:
    """Name -> number of the calls of these groups on one of `MACHINES`."""
    found = {}
    for entry in ",".join(groups).split(","):
        name, *columns = entry.split()
        number = columns[MACHINES[machine][1]]
        if number != "-":
            found[name] = int(number)
    return found
