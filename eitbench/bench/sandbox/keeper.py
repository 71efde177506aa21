"""The parent of a guest, which outlives it and takes its whole family along; run by its path, as
``python -P keeper.py FOLDER MEMORY TASKS DISK FILES``, the last four as in `Limits`.

It reads nothing that a guest says and is out of its reach. It waits for one of four things: the
guest ends, the host asks for it, the host is no longer there, so that nobody holds the other end of
the pipe from which the guest reads, or the guest and all that it has started take more than they
may, which is then said on standard error. Then it kills the guest and all that it has started, and
ends as the guest did. Where the host is no longer there it also removes the guest's folder.

Where the system grants it, both live in namespaces of their own: of processes, of shared memory and
message queues, of networks, mounts and users.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

NAMESPACES = {"user": 1 << 28, "mount": 1 << 17, "ipc": 1 << 27, "pid": 1 << 29, "net": 1 << 30}
"""Their names, and what the kernel calls them."""
ASKED = signal.SIGUSR1
"""The signal by which the host asks for the guest's end; SIGTERM says that the host has ended."""
_HEARD = (signal.SIGTERM, ASKED, signal.SIGCHLD)
_END_WITH_PARENT, _ADOPT, _DUMPABLE = 1, 36, 4
"""What ``prctl`` is asked for."""
_LONGEST = 5.0
"""s that the guest's orphans may take to die"""
_TASKS, _REST = 0.1, 0.5
"""s between two looks at how many tasks there are, and at memory and disk"""
_SHARE = 20
"""A look is followed by so many times its own length without one."""
_DEEPEST = 64
"""folders within each other"""
_MIB = 1 << 20


class Limits(NamedTuple):
    """What a guest may take, together with all that it has started."""

    memory: int = 8 << 30
    """bytes of address space of each process, and of memory held by all of them together"""
    tasks: int = 512
    """processes and their threads"""
    disk: int = 1 << 30
    """bytes of all files"""
    files: int = 10_000
    """files and folders"""


def main() -> None:
    """Start a guest and wait for its end."""
    folder, *numbers = sys.argv[1:]
    limits = Limits(*map(int, numbers))
    linux = sys.platform.startswith("linux")
    separate = _separate() if linux else []
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    for each in _HEARD:  # all that they do is to wake what waits below
        signal.signal(each, lambda *_: None)
    signal.set_wakeup_fd(wake)
    if linux:
        _prctl(_END_WITH_PARENT, signal.SIGTERM)
        _prctl(_ADOPT, 1)
    guest = os.fork()
    if not guest:
        signal.set_wakeup_fd(-1)
        for end in (woken, wake):
            os.close(end)
        _play(folder, limits, separate)
        return
    if linux:
        _prctl(_DUMPABLE, 0)
    os.close(1)  # else the host would not notice that the guest has closed it
    watch = _Watch(folder, limits) if linux else None
    is_alone = _wait(guest, woken, watch)
    status = _end(guest)
    if watch and watch.excess:  # now that the guest can say nothing any more
        os.write(2, watch.excess.encode())
    if is_alone:
        remove(folder)
    _end_as(status)


def remove(folder: str) -> None:
    """Remove a folder that a stranger has filled, as far as that is possible: however deep it is,
    whatever its modes are; links are not followed."""
    with suppress(OSError):
        _empty(_open(folder))
        os.rmdir(folder)


def _empty(here: int) -> None:
    """Remove all that is in an open folder, and close it; no path is longer than a name, and few
    folders are open at once."""
    above: list[tuple[str, tuple[int, int], list[str]]] = []  # what to remove there, and after that
    try:
        folders = _cleared(here)
        while folders or above:
            if folders:
                above.append((folders.pop(), _identity(here), folders))
                here = _instead(here, _open(above[-1][0], here))
                folders = _cleared(here)
            else:
                name, expected, folders = above.pop()
                here = _instead(here, os.open("..", os.O_RDONLY | os.O_DIRECTORY, dir_fd=here))
                if _identity(here) != expected:  # somebody has moved it, who should be dead
                    raise OSError(f"{name!r} is elsewhere")
                os.rmdir(name, dir_fd=here)
    finally:
        os.close(here)


def _cleared(place: int) -> list[str]:
    """The folders in an open folder, from which all else is removed."""
    folders = []
    for name in os.listdir(place):
        if stat.S_ISDIR(os.stat(name, dir_fd=place, follow_symlinks=False).st_mode):
            folders.append(name)
        else:
            os.unlink(name, dir_fd=place)
    return folders


def _identity(place: int) -> tuple[int, int]:
    status = os.fstat(place)
    return status.st_dev, status.st_ino


def _instead(before: int, after: int) -> int:
    """The second of two open folders; the first is closed."""
    os.close(before)
    return after


def _open(name: str, place: int | None = None) -> int:
    """A folder, that its owner can read and write from now on."""
    if hasattr(os, "O_PATH"):
        closed = os.open(name, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=place)
        try:
            os.chmod(f"/proc/self/fd/{closed}", 0o700)
        finally:
            os.close(closed)
    return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=place)


def _opened(name: str, place: int | None = None) -> int:
    """The same; one that can be read is left as it is."""
    try:
        return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=place)
    except PermissionError:
        return _open(name, place)


def _separate() -> list[str]:
    """Go into namespaces of its own, the guest into those of processes; which they are."""
    libc = ctypes.CDLL(None, use_errno=True)
    user, group = os.getuid(), os.getgid()
    for names in (list(NAMESPACES), [name for name in NAMESPACES if name != "user"]):
        if libc.unshare(sum(NAMESPACES[name] for name in names)) == 0:
            break
    else:
        return []
    if "user" in names:
        with suppress(OSError):  # without names for them the rights are the same
            for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"),
                               ("gid_map", f"{group} {group} 1")):
                with open(f"/proc/self/{name}", "w") as file:
                    file.write(text)
    return names


def _play(folder: str, limits: Limits, separate: list[str]) -> None:
    """In the child: what the guest is."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 2)  # there the keeper speaks
    os.close(silent)
    for each in _HEARD:
        signal.signal(each, signal.SIG_DFL)
    os.setsid()  # so that it can be killed with all its children at once
    if sys.platform.startswith("linux"):
        _prctl(_END_WITH_PARENT, signal.SIGKILL)
    from eitbench.bench.sandbox.guest import main as play
    play(folder, limits, separate)


def _wait(guest: int, woken: int, watch: _Watch | None) -> bool:
    """Until the guest has ended, or must; whether that is because the host is gone."""
    poll = select.poll()
    poll.register(0, 0)  # nothing but that the host has hung up
    poll.register(woken, select.POLLIN)
    while True:
        found = dict(poll.poll(watch.rest() if watch else None))
        signals = os.read(woken, 512) if woken in found else b""
        if 0 in found or signal.SIGTERM in signals:
            return True
        if ASKED in signals:
            return False
        # not reaped yet: its number stays that of its session
        if os.waitid(os.P_PID, guest, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return False
        _reap(guest)
        if watch and watch.look():
            return False


def _end(guest: int) -> int:
    """Kill the guest and all its descendants; the guest's status."""
    os.kill(guest, signal.SIGKILL)
    with suppress(ProcessLookupError, PermissionError):  # it had no time to make its session
        os.killpg(guest, signal.SIGKILL)
    status = os.waitpid(guest, 0)[1]
    until = time.monotonic() + _LONGEST
    with suppress(ChildProcessError):  # there are no more
        while time.monotonic() < until:
            for orphan in _children():
                os.kill(orphan, signal.SIGKILL)
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(0.01)
    return status


def _reap(guest: int) -> None:
    """Let go of the guest's orphans that have ended, else they fill the table of processes."""
    while done := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
        if done.si_pid == guest:
            return
        os.waitpid(done.si_pid, os.WNOHANG)


def _children(thread: str = "thread-self") -> list[int]:
    """Processes that a thread in /proc has started, or that were left to it."""
    try:
        with open(f"/proc/{thread}/children") as file:
            return [int(number) for number in file.read().split()]
    except OSError:
        return []


def _end_as(status: int) -> None:
    if os.WIFSIGNALED(status):
        import resource  # not on Windows
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(os.WEXITSTATUS(status))


def _prctl(what: int, value: int) -> None:
    ctypes.CDLL(None).prctl(what, value, 0, 0, 0)


class _TooDeepError(Exception):
    """Folders lie too deep within each other."""


class _Watch:
    """Looks now and then at what a guest takes, with all that it has started."""

    def __init__(self, folder: str, limits: Limits) -> None:
        self.excess = ""
        """What was too much; empty as long as nothing is."""
        self._folder = folder
        self._limits = limits
        self._tasks_at = time.monotonic() + _TASKS
        self._rest_at = time.monotonic() + _REST

    def rest(self) -> int:
        """ms to the next look."""
        left = min(self._tasks_at, self._rest_at) - time.monotonic()
        return max(0, int(1e3 * left)) + 1

    def look(self) -> str:
        """`excess`, if it was time to look."""
        begin = time.monotonic()
        if begin >= self._tasks_at:
            processes, tasks = _family(self._limits.tasks)
            if tasks > self._limits.tasks:
                self.excess = f"more than {self._limits.tasks} processes and threads"
            self._tasks_at = _next(begin, _TASKS)
        if not self.excess and begin >= self._rest_at:
            processes, _ = _family(self._limits.tasks)
            most = self._limits.memory
            if _held(processes, False) > most and _held(processes, True) > most:
                self.excess = f"more than {most // _MIB} MiB of memory"
            self.excess = self.excess or self._stored(processes)
            self._rest_at = _next(begin, _REST)
        return self.excess

    def _stored(self, processes: list[int]) -> str:
        """What there is too much of on the disk."""
        sizes: dict[tuple[int, int], int] = {}
        count = 0
        try:
            for status in _all_in(self._folder):
                count += 1
                sizes[status.st_dev, status.st_ino] = 512 * status.st_blocks
                if count > self._limits.files:
                    return f"more than {self._limits.files} files"
        except _TooDeepError:
            return f"more than {_DEEPEST} folders within each other"
        for process in processes:
            sizes |= _removed(process)
        if sum(sizes.values()) > self._limits.disk:
            return f"files of more than {self._limits.disk // _MIB} MiB"
        return ""


def _next(begin: float, least: float) -> float:
    """When to look again after a look that has just ended."""
    now = time.monotonic()
    return now + max(least, _SHARE * (now - begin))


def _family(most: int) -> tuple[list[int], int]:
    """This process' descendants and how many threads they have; no further than ``most``."""
    found = list[int]()
    tasks = 0
    left = _children()
    while left and tasks <= most:
        process = left.pop()
        found.append(process)
        try:
            threads = os.listdir(f"/proc/{process}/task")
        except OSError:
            continue
        tasks += len(threads)
        for thread in threads[:most]:
            left += _children(f"{process}/task/{thread}")
    return found, tasks


def _held(processes: list[int], exactly: bool) -> int:
    """bytes of memory; ``exactly``: what they share is counted once, which takes longer."""
    total = 0
    for process in processes:
        with suppress(OSError), open(f"/proc/{process}/{'smaps_rollup' if exactly else 'status'}"
                                     ) as file:
            total += sum(1024 * int(line.split()[1]) for line in file
                         if line.startswith(("Pss:", "VmRSS:")))
    return total


def _all_in(folder: str) -> Iterator[os.stat_result]:
    """Of all that is in a folder; no more folders are open than they lie within each other."""
    here = _opened(folder)
    opened = [(here, os.listdir(here))]
    try:
        while opened:
            here, names = opened[-1]
            if not names:
                os.close(opened.pop()[0])
                continue
            name = names.pop()
            with suppress(OSError):  # it changes meanwhile; there is a next look
                status = os.stat(name, dir_fd=here, follow_symlinks=False)
                yield status
                if stat.S_ISDIR(status.st_mode):
                    if len(opened) == _DEEPEST:
                        raise _TooDeepError
                    below = _opened(name, here)
                    opened.append((below, os.listdir(below)))
    finally:
        for place, _ in opened:
            os.close(place)


def _removed(process: int) -> dict[tuple[int, int], int]:
    """Sizes of files that have no name any more, and that a process still has open."""
    sizes = {}
    place = f"/proc/{process}/fd"
    with suppress(OSError):
        for number in os.listdir(place):
            with suppress(OSError):
                status = os.stat(f"{place}/{number}")
                if stat.S_ISREG(status.st_mode) and not status.st_nlink:
                    sizes[status.st_dev, status.st_ino] = 512 * status.st_blocks
    return sizes


if __name__ == "__main__":
    main()
