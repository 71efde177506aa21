"""The bank: exactly what is missing is made, with the bits of a recording made alone, and nothing
done is lost."""

import re
import shutil
from types import SimpleNamespace

import eitbench  # noqa: F401 (registers)
import pytest
from eitbench.cli.app import app
from eitbench.data import bank, recordings
from eitbench.data.bank import fill, recording_bytes
from eitbench.data.episodes import simulate, simulate_together
from eitbench.data.recordings import is_recorded, make_recording, recording, recording_path
from eitbench.data.regions import are_kept, integrals_path
from eitbench.data.store import CACHE_VARIABLE, folder
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.pipe2d_drifting import PIPE_2D_DRIFTING
from joblib.externals.loky import get_reusable_executor
from typer.testing import CliRunner

from recorded import forget
from short import PLAIN, merged, shorten
from tiny_worlds import CHANGES, TINY

SEEDS = range(10)
"""A full batch of eight and a remainder."""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """The ids of the plain pipe play the tiny world; recordings lie in a folder of this test's
    own."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    shorten(monkeypatch, dict.fromkeys(PLAIN, CHANGES))
    forget()
    yield folder(TINY)
    forget()


@pytest.fixture(scope="module")
def alone():
    """The bytes of each recording when its episode is simulated by itself."""
    return {seed: make_recording(TINY, seed, simulate(TINY, seed, cache=False)).tobytes()
            for seed in SEEDS}


@pytest.fixture
def asked(monkeypatch):
    """The seeds of each batch that is simulated in this process."""
    batches = []

    def counting(world, seeds, *more, **options):
        batches.append(list(seeds))
        return simulate_together(world, seeds, *more, **options)

    monkeypatch.setattr(bank, "simulate_together", counting)
    return batches


def names(place):
    """What lies in the folder beside the outline."""
    return sorted(path.name for path in place.iterdir() if path.name != "outline.npz")


def stamps(place):
    """Which files they are and when they were written."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns)
            for path in place.glob("*.npy")}


# -- fill ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_recordings_have_the_bits_of_those_made_alone(n_jobs, place, alone, monkeypatch):
    """Eight at once or spread over processes: each recording is the one of its seed, and no truth
    lies beside it."""
    get_reusable_executor().shutdown(wait=True)      # workers keep the cache folder they began with
    assert fill(TINY, SEEDS, n_jobs=n_jobs) == 10
    assert names(place) == sorted(f"{seed}.npy" for seed in SEEDS)
    monkeypatch.setattr(recordings, "simulate", None)               # all are there
    assert {seed: recording(TINY, seed).tobytes() for seed in SEEDS} == alone


def test_only_what_is_missing_is_made(place, asked, alone):
    """Seeds asked for twice are made once, those that are there are not touched, and the number is
    the true one."""
    recording(TINY, 2)
    (place / "2.truth.npz").unlink()
    assert fill(TINY, [4, 2, 1, 4]) == 2 and asked == [[4, 1]]
    before = stamps(place)
    assert before.keys() == {"1.npy", "2.npy", "4.npy"} == set(names(place))
    assert fill(TINY, [1, 2, 4]) == 0 and len(asked) == 1
    assert fill(TINY, []) == 0 and len(asked) == 1
    assert fill(TINY, SEEDS) == 7 and asked[1:] == [[0, 3, 5, 6, 7, 8, 9]]
    after = stamps(place)
    assert len(after) == 10 and {name: after[name] for name in before} == before
    assert {seed: recording(TINY, seed).tobytes() for seed in SEEDS} == alone


def test_batches_hold_eight(place, asked):
    """More seeds than a batch holds make one full batch and the rest."""
    assert fill(TINY, SEEDS) == 10 and [len(batch) for batch in asked] == [8, 2]


def test_interrupted_fill_keeps_what_is_done_and_goes_on(place, asked, alone, monkeypatch):
    """Ctrl-C after the third recording: three are there and sound, and the next call makes the
    other seven."""
    stored = []

    def interrupted(path, entries):
        if len(stored) == 3:
            raise KeyboardInterrupt
        stored.append(path)
        recordings.store_recording(path, entries)

    with monkeypatch.context() as patch:
        patch.setattr(bank, "store_recording", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fill(TINY, SEEDS)
    forget()
    assert [seed for seed in SEEDS if is_recorded(TINY, seed)] == [0, 1, 2]
    assert len(names(place)) == 3
    before = stamps(place)
    assert fill(TINY, SEEDS) == 7 and asked[1] == [3, 4, 5, 6, 7, 8, 9]
    assert {name: stamp for name, stamp in stamps(place).items() if name in before} == before
    assert {seed: recording(TINY, seed).tobytes() for seed in SEEDS} == alone


@pytest.mark.parametrize("damage", [
    pytest.param(lambda data: data[:-1], id="short"),
    pytest.param(lambda data: b"\0" * len(data), id="zeros"),
    pytest.param(lambda data: data[:9999] + bytes([data[9999] ^ 4]) + data[10_000:], id="a bit"),
])
def test_damaged_recording_is_made_again(damage, place, asked, alone):
    """It counts as missing, and the sound ones beside it do not."""
    fill(TINY, [0, 1, 2])
    path = recording_path(TINY, 1)
    path.write_bytes(damage(path.read_bytes()))
    forget()
    assert fill(TINY, [0, 1, 2]) == 1 and asked[1:] == [[1]]
    assert {seed: recording(TINY, seed).tobytes() for seed in (0, 1, 2)} == {seed: alone[seed]
                                                                             for seed in (0, 1, 2)}


def test_size_is_that_of_the_files(place):
    """What is foretold of a recording is within 1 % of what it takes on disk."""
    fill(TINY, [0])
    assert (place / "0.npy").stat().st_size == pytest.approx(recording_bytes(TINY), rel=0.01)
    real = recordings.recording_type(PIPE_2D, 1701).itemsize * 98
    assert recording_bytes(PIPE_2D) == real == pytest.approx(881_000, rel=0.01)


def test_what_lies_beside_a_recording_counts(place):
    """Where only a region counts, its integrals are made and kept too, and are missing if they are
    damaged; the size is foretold with them."""
    world = PIPE_2D_DRIFTING.changed(merged(CHANGES, {"flow": {"velocity_range": [40.0, 50.0]}}))
    assert fill(world, [0, 1]) == 2 and fill(world, [0, 1]) == 0
    files = [recording_path(world, 0), integrals_path(world, 0)]
    size = sum(path.stat().st_size for path in files)
    assert recording_bytes(world) == pytest.approx(size, rel=0.02)
    files[1].write_bytes(files[1].read_bytes()[:-1])
    assert is_recorded(world, 0) and not are_kept(world, 0)
    assert fill(world, [0, 1]) == 1 and are_kept(world, 0)


@pytest.mark.parametrize("seed", [-1, 1.0, True, "1"])
def test_fill_names_what_is_wrong(seed, place):
    """Seeds that would be cast, and no processes at all."""
    with pytest.raises(ValueError, match="seeds must be an integer of at least 0"):
        fill(TINY, [seed])
    with pytest.raises(ValueError, match="n_jobs must be an integer of at least 1"):
        fill(TINY, [1], n_jobs=0)


def test_workers_write_where_the_parent_looks(monkeypatch, tmp_path):
    """$EITBENCH_CACHE changes between two fills; workers that live on do not keep the old one."""
    for name in ("one", "two"):
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / name))
        forget()
        fill(TINY, [0, 1], n_jobs=2)
        assert is_recorded(TINY, 0) and is_recorded(TINY, 1), name


# -- the command line ------------------------------------------------------------------------------


def eitbench_bank(*arguments):
    """What the command does: exit code, standard output, standard error without boxes and line
    breaks."""
    done = CliRunner().invoke(app, ["bank", *arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception                                          # a user would see a traceback
    return done.exit_code, done.stdout, re.sub(r"[│╭╮╰╯─\s]+", " ", done.stderr)


def test_command_fills_and_resumes(place, asked, alone):
    """It says what it made and what was there, and keeps it where environments look."""
    code, said, _ = eitbench_bank("--seeds", "train:0-2", "-j", "1")
    assert code == 0
    assert "3 simulated, 0 were there" in said
    assert f"3 episodes, 0 MB in {place}" in said
    code, said, _ = eitbench_bank("--seeds", "train:0-3", "-j", "1", "--env",
                                  "eitbench/Pipe2DSmoothing-v0")
    assert code == 0 and "1 simulated, 3 were there" in said and asked == [[0, 1, 2], [3]]
    assert names(place) == ["0.npy", "1.npy", "2.npy", "3.npy"]
    assert {seed: recording(TINY, seed).tobytes() for seed in range(4)} == {seed: alone[seed]
                                                                            for seed in range(4)}


def test_command_means_the_seeds_of_the_split(place, asked):
    """dev:0 is not train:0."""
    assert eitbench_bank("--seeds", "dev:0", "-j", "1")[0] == 0
    assert asked == [[100_000]] and names(place) == ["100000.npy"]


def test_command_states_the_size_on_disk(place, monkeypatch):
    """Within 1 % of as many files as one that was made."""
    eitbench_bank("--seeds", "train:0", "-j", "1")
    monkeypatch.setattr(bank, "fill", lambda *_, **__: 0)
    code, said, _ = eitbench_bank("--seeds", "train:0-29999")
    stated = re.search(r"30000 episodes, (\d+) MB", said)
    assert code == 0
    assert float(stated[1]) * 1e6 == pytest.approx(30_000 * (place / "0.npy").stat().st_size,
                                                   rel=0.01)


def test_full_disk_is_refused_before_anything_is_simulated(place, asked, monkeypatch):
    """One byte too few: exit code 2 and how much is needed; with just enough it goes ahead."""
    looked = []

    def disk(free):
        monkeypatch.setattr(shutil, "disk_usage", lambda path: looked.append(path)
                            or SimpleNamespace(free=free))

    disk(2 * recording_bytes(TINY) - 1)
    code, said, complaint = eitbench_bank("--seeds", "train:0-1", "-j", "1")
    assert code == 2
    assert "seeds need" in complaint
    assert "are free" in complaint
    assert "simulated" not in said
    assert asked == [] and names(place) == [] and looked[0] in (place, *place.parents)
    disk(2 * recording_bytes(TINY))
    assert eitbench_bank("--seeds", "train:0-1", "-j", "1")[0] == 0 and asked == [[0, 1]]


@pytest.mark.parametrize(("arguments", "message"), [
    (["--seeds", "exam:1"], "seeds must name one of the splits train, dev, test, got 'exam:1'"),
    (["--seeds", "train:1-"], "seeds must look like 'test:0-4'"),
    (["--seeds", "train:4-2"], "must increase"),
    (["--seeds", "train:0-100000"], "stay below 100000"),
    (["--seeds", "-1"], "seeds must look like"),
    (["--seeds", ""], "seeds must look like"),
    (["--env", "eitbench/Pipe4D-v0"], "env must be one of eitbench/Pipe2D-v0"),
    (["-j", "0"], "--jobs"),
])
def test_mistakes_are_explained(arguments, message, place, asked):
    """Exit code 2 and a sentence that names the argument; no traceback, and nothing is
    simulated."""
    code, said, complaint = eitbench_bank(*arguments)
    assert code == 2 and said == "" and message in complaint and "Traceback" not in complaint
    assert asked == [] and (not place.exists() or names(place) == [])


def test_command_with_an_unwritable_cache_is_explained(monkeypatch):
    """No traceback."""
    monkeypatch.setenv(CACHE_VARIABLE, "/dev/null/cache")
    forget()
    code, _, complaint = eitbench_bank("--seeds", "train:0", "-j", "1")
    assert code == 2 and "recordings cannot be kept in" in complaint


def test_command_resumes_though_only_the_rest_fits(place, asked, monkeypatch):
    """What is there already needs no room."""
    eitbench_bank("--seeds", "train:0-3", "-j", "1")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=recording_bytes(TINY)))
    assert eitbench_bank("--seeds", "train:0-4", "-j", "1")[0] == 0 and asked[1:] == [[4]]
