"""The walls around a guest, each by itself: system calls, namespaces, capabilities, and what honest methods need."""

import ctypes
import json
import os
import platform
import sys
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench.run import Job, run_jobs
from eitbench.bench.sandbox import calls, guests, keeper
from eitbench.bench.sandbox.host import Guest, GuestError
from eitbench.bench.store import EpisodeStore
from eitbench.data.store import CACHE_VARIABLE

from tiny import FILTER, without_namespaces, write_baseline

KWARGS = json.loads(FILTER.kwargs)
MACHINE = platform.machine()
filtered = pytest.mark.skipif(not sys.platform.startswith("linux") or MACHINE not in calls.MACHINES,
                              reason="system calls are not filtered here")
REFUSED = """
shmget 29 194, shmat 30 196, shmctl 31 195, shmdt 67 197, semget 64 190, semop 65 193, semctl 66 191,
semtimedop 220 192, msgget 68 186, msgsnd 69 189, msgrcv 70 188, msgctl 71 187, add_key 248 217, request_key 249 218,
keyctl 250 219, mq_open 240 180, mq_unlink 241 181, userfaultfd 323 282, perf_event_open 298 241, bpf 321 280,
ptrace 101 117, process_vm_readv 310 270, process_vm_writev 311 271, process_madvise 440 440, io_uring_setup 425 425,
io_uring_enter 426 426, io_uring_register 427 427, mount 165 40, umount2 166 39, pivot_root 155 41, chroot 161 51,
fsopen 430 430, open_tree 428 428, move_mount 429 429, fsmount 432 432, mount_setattr 442 442, setns 308 268,
unshare 272 97, kexec_load 246 104, init_module 175 105, finit_module 313 273, delete_module 176 106, socket 41 198,
socketpair 53 199, connect 42 203, bind 49 200, pidfd_open 434 434, pidfd_getfd 438 438, pidfd_send_signal 424 424,
rt_sigqueueinfo 129 138, rt_tgsigqueueinfo 297 240, setsid 112 157, setpgid 109 154, setuid 105 146,
setresuid 117 147, setgroups 116 159, capset 126 91, seccomp 317 277, kcmp 312 272, open_by_handle_at 304 265,
name_to_handle_at 303 264, inotify_init1 294 26, fanotify_init 300 262, memfd_create 319 279, memfd_secret 447 447,
syslog 103 116, sethostname 170 161, reboot 169 142, swapon 167 224, acct 163 89, quotactl 179 60,
settimeofday 164 170, clock_settime 227 112, adjtimex 159 171, personality 135 92, sched_setaffinity 203 122,
sched_setscheduler 144 119, sched_setattr 314 274, setpriority 141 140, ioprio_set 251 30, fchmod 91 52,
fchmodat 268 53, fchown 93 55, utimensat 280 88, setxattr 188 5, move_pages 279 239, migrate_pages 256 238,
lookup_dcookie 212 18, nfsservctl 180 42, vmsplice 278 75, splice 275 76, tee 276 77, sync 162 81,
syncfs 306 267, execveat 322 281, landlock_create_ruleset 444 444
"""
"""Of many that must be refused, names and numbers on x86_64 and aarch64, as the kernel's headers have them."""


def refused(machine):
    """Name -> number."""
    return calls.numbers(machine, [REFUSED])


def judged(steps, architecture, number, arguments=(0, 0)):
    """What a filter answers, as the kernel would run it."""
    memory = {0: number, 4: architecture, 16: arguments[0], 24: arguments[1]}
    at, held = 0, 0
    while True:
        deed, skip_if, skip_else, value = steps[at]
        if deed == 0x06:
            return value
        if deed == 0x20:
            held = memory[value]
        else:
            holds = {0x15: held == value, 0x35: held >= value, 0x45: bool(held & value)}[deed]
            at += skip_if if holds else skip_else
        at += 1


@pytest.mark.parametrize("machine", calls.MACHINES)
def test_only_named_calls_are_allowed(machine):
    """On both architectures, and none of the other architecture or of 32-bit pointers."""
    architecture = calls.MACHINES[machine][0]
    named = calls.numbers(machine)
    assert len(set(named.values())) == len(named) > 130 and not set(named.values()) & set(refused(machine).values())
    for signals in (True, False):
        steps = calls.steps(machine, 17, signals)
        assert len(steps) < 4096 and all(skip < 256 for step in steps for skip in step[1:3])

        def allows(number, *arguments, steps=steps):
            return judged(steps, architecture, number, arguments or (0, 0)) == 0x7FFF0000

        asked = {number for number in range(1000) if allows(number)}
        assert asked <= set(named.values())
        by_argument = {"clone3", "prctl", "ioctl", "kill", "tkill", "tgkill"}
        assert {name for name, number in named.items() if number not in asked} <= by_argument
        assert allows(named["kill"]) == allows(named["tkill"]) == signals
        assert allows(named["tgkill"], 17, 0) and allows(named["tgkill"], 18, 0) == signals
        assert not any(allows(0x40000000 + number) for number in range(1000))
        assert not any(judged(steps, 0x40000003, number) == 0x7FFF0000 for number in range(1000))
        assert allows(named["clone"], 0x3D0F00, 0) and not any(
            allows(named["clone"], flag, 0) for flag in (*keeper.NAMESPACES.values(), 1 << 25, 1 << 26, 1 << 15))
        assert allows(named["prctl"], 15, 0) and not allows(named["prctl"], 1, 0)
        assert not allows(named["prctl"], 4, 0) and not allows(named["prlimit64"], 1, 0)
        assert allows(named["ioctl"], 1, 0x5401) and not allows(named["ioctl"], 1, 0x5412)
        assert not any(allows(named["fcntl"], 3, each) for each in (8, 10, 15, 1024, 1026))


ATTACK = """
import ctypes, os
libc = ctypes.CDLL(None, use_errno=True)
def called(number, *arguments):
    result = libc.syscall(number, *arguments)
    return result if result >= 0 else -ctypes.get_errno()
"""


@filtered
def test_calls_are_refused(tmp_path):
    """Each of them as if it were not there or not permitted, which its arguments, all null, would not be told."""
    tried = refused(MACHINE)
    source = f"{ATTACK}\nfound = {{name: called(number, 0, 0, 0, 0, 0, 0) for name, number in {tried!r}.items()}}"
    source += "\nfound['the end'] = libc.prctl(1, 0, 0, 0, 0)\nfound['to see'] = libc.prctl(4, 0, 0, 0, 0)"
    path = write_baseline(tmp_path, init=f"exec({source!r}, globals())", update="raise RuntimeError(repr(found))")
    with Guest("estimation", FILTER.id, KWARGS, path) as guest:
        assert "seccomp" in guest.walls
        guest.begin()
        with pytest.raises(GuestError) as said:
            guest.update(np.zeros(4), np.zeros(4))
    found = eval(str(said.value).removeprefix("RuntimeError: "))
    assert set(found) == {*tried, "the end", "to see"}
    assert {name: status for name, status in found.items() if status not in (-13, -38, -1)} == {}


MESSAGE = ATTACK + """
shared, attached, key = NUMBERS
libc.syscall.restype = ctypes.c_long
number = called(shared, 20250705, 4096, 0o1666)
place = called(attached, number, 0, 0) if number >= 0 else -1
before = ctypes.string_at(place, 5) if place > 0 else b""
if place > 0:
    ctypes.memmove(place, b"truth", 5)
kept = called(key, b"user", b"eitbench-test", b"truth", 5, -4 & 0xFFFFFFFF)
"""


@filtered
@pytest.mark.parametrize("granted", [True, False])
def test_a_guest_leaves_nothing_for_another(granted, tmp_path, monkeypatch):
    """Neither in shared memory nor in a keyring, with namespaces and without; here the same code can."""
    if not granted:
        monkeypatch.setattr(keeper, "__file__", without_namespaces(tmp_path))
    numbers = [refused(MACHINE)[name] for name in ("shmget", "shmat", "add_key")]
    source = f"NUMBERS = {numbers}\n{MESSAGE}"
    path = write_baseline(tmp_path, init=f"exec({source!r}, globals())",
                          update="raise RuntimeError(f'{before} {place > 0} {kept > 0}')")
    for _ in range(2):
        with Guest("estimation", FILTER.id, KWARGS, path) as guest:
            assert ("ipc" in guest.walls) <= granted
            guest.begin()
            with pytest.raises(GuestError, match="RuntimeError: b'' False False"):
                guest.update(np.zeros(4), np.zeros(4))
    within: dict = {}
    try:
        exec(source, within)
        assert within["place"] > 0
    finally:
        ctypes.CDLL(None).shmctl(within["number"], 0, None)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux has namespaces")
def test_namespaces_are_its_own(tmp_path):
    """Those that it says it has; and it has no capability, also if root plays it."""
    with Guest("estimation", FILTER.id, KWARGS, write_baseline(tmp_path)) as guest:
        for name, kind in (("user", "user"), ("mount", "mnt"), ("ipc", "ipc"), ("pid", "pid"), ("net", "net")):
            there, here = (os.readlink(f"/proc/{process}/ns/{kind}") for process in (guest.process, "self"))
            assert (there != here) == (name in guest.walls)
        status = Path(f"/proc/{guest.process}/status").read_text()
        assert "CapEff:\t0000000000000000" in status and "CapPrm:\t0000000000000000" in status


HONEST = """
import concurrent.futures, mmap, platform, shutil, signal, sqlite3, subprocess, tempfile, time, zipfile
import numba, pandas, scipy.fft, scipy.linalg, scipy.optimize, scipy.sparse, scipy.sparse.linalg
ctypes = __import__("ctypes")
assert numba.njit(lambda x: x * 2.0)(np.arange(3.0))[1] == 2.0
assert numba.njit(parallel=True)(lambda x: x.sum())(np.arange(3.0)) == 3.0
assert scipy.sparse.linalg.splu(scipy.sparse.eye(50, format="csc")).solve(np.ones(50))[0] == 1.0
np.linalg.svd(np.random.default_rng().normal(size=(200, 200)))
assert subprocess.run("echo a | cat", shell=True, capture_output=True).stdout == b"a\\n"
platform.platform(), platform.processor()
with concurrent.futures.ThreadPoolExecutor(3) as pool:
    assert list(pool.map(abs, [-1, 1])) == [1, 1]
home = Path.home() / "mine"
home.mkdir()
(home / "b").write_text("x")
shutil.copyfile(home / "b", home / "c")
shutil.move(home / "c", home / "d")
(home / "l").symlink_to("b")
assert len(list(home.rglob("*"))) == 3
np.save(home / "x.npy", np.arange(5))
np.load(home / "x.npy", mmap_mode="r+")[0] = 3
with tempfile.TemporaryFile() as file:
    file.write(b"x")
sqlite3.connect(home / "db").execute("create table a(b)")
shutil.rmtree(home)
rung = []
signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
signal.setitimer(signal.ITIMER_REAL, 0.01)
time.sleep(0.1)
assert rung and ctypes.CFUNCTYPE(ctypes.c_int)(lambda: 3)() == 3
child = os.fork()
if not child:
    time.sleep(60)
os.kill(child, signal.SIGTERM)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM
"""
"""What estimators do: compile, solve, ask the machine, files and databases of their own, threads, children, alarms."""


def test_honest_methods_do_what_they_need(tmp_path):
    """All of it, behind every wall that there is here."""
    path = write_baseline(tmp_path, init=f"exec({HONEST!r}, globals())")
    with Guest("estimation", FILTER.id, KWARGS, path) as guest:
        guest.begin()
        assert guest.update(np.zeros(4), np.zeros(4)).mean[0] == 29.0


def test_walls_are_recorded(run_cache, tmp_path, monkeypatch):
    """Of each run: those that its guests had; none where there was no guest."""
    monkeypatch.setenv(CACHE_VARIABLE, run_cache)
    store = EpisodeStore(tmp_path / "results")
    path = write_baseline(tmp_path)
    run_jobs([Job(FILTER, path, 1, True), Job(FILTER, "homogeneous", 1)], store)
    mine, ours = sorted(store.write_records(), key=lambda record: record["method"] != "mine")
    with Guest("estimation", FILTER.id, KWARGS, path) as guest:
        assert mine["runs"][0]["walls"] == sorted(guest.walls) and "walls" not in ours["runs"][0]
    guests.close()
