"""The parent of a guest, which outlives it and takes its whole family along; run by its path, as
``python -P keeper.py FOLDER MEMORY``.

It reads nothing that a guest says and is out of its reach. It waits for one of three things: the
guest ends, the host asks for it, or the host is no longer there, so that nobody holds the other end
of the pipe from which the guest reads. Then it kills the guest and all that it has started, and
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
from contextlib import suppress

NAMESPACES = {"user": 1 << 28, "mount": 1 << 17, "ipc": 1 << 27, "pid": 1 << 29, "net": 1 << 30}
"""Their names, and what the kernel calls them."""
ASKED = signal.SIGUSR1
"""The signal by which the host asks for the guest's end; SIGTERM says that the host has ended."""
_HEARD = (signal.SIGTERM, ASKED, signal.SIGCHLD)
_END_WITH_PARENT, _ADOPT, _DUMPABLE = 1, 36, 4
"""What ``prctl`` is asked for."""
_LONGEST = 5.0
"""s that the guest's orphans may take to die"""


def main() -> None:
    """Start a guest and wait for its end."""
    folder, memory = sys.argv[1:]
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
        _play(folder, int(memory), separate)
        return
    if linux:
        _prctl(_DUMPABLE, 0)
    os.close(1)  # else the host would not notice that the guest has closed it
    is_alone = _wait(guest, woken)
    status = _end(guest)
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
            _write("/proc/self/setgroups", "deny")
            _write("/proc/self/uid_map", f"{user} {user} 1")
            _write("/proc/self/gid_map", f"{group} {group} 1")
    return names


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)


def _play(folder: str, memory: int, separate: list[str]) -> None:
    """In the child: what the guest is."""
    for each in _HEARD:
        signal.signal(each, signal.SIG_DFL)
    os.setsid()  # so that it can be killed with all its children at once
    if sys.platform.startswith("linux"):
        _prctl(_END_WITH_PARENT, signal.SIGKILL)
    from eitbench.bench.sandbox.guest import main as play
    play(folder, memory, separate)


def _wait(guest: int, woken: int) -> bool:
    """Until the guest has ended, or must; whether that is because the host is gone."""
    poll = select.poll()
    poll.register(0, 0)  # nothing but that the host has hung up
    poll.register(woken, select.POLLIN)
    while True:
        found = dict(poll.poll())
        signals = os.read(woken, 512) if woken in found else b""
        if 0 in found or signal.SIGTERM in signals:
            return True
        if ASKED in signals:
            return False
        # not reaped yet: its number stays that of its session
        if os.waitid(os.P_PID, guest, os.WEXITED | os.WNOHANG | os.WNOWAIT):
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


def _children() -> list[int]:
    """Who left the guest's session, and was left to this process."""
    try:
        with open("/proc/thread-self/children") as file:
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


if __name__ == "__main__":
    main()
