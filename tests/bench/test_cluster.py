"""Runs on a cluster give the same records as local runs, also if a worker is killed.

Tests of ray and dask need the extra cluster: `pip install -c constraints.txt -e '.[test,cluster]'`, then `python -m
pytest -m cluster`.
"""

import importlib
import importlib.util
import warnings

import pytest
from eitbench.bench.run import Job, run_episode, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.data import parallel
from eitbench.data.parallel import BACKENDS, WorkerLostError, run_parallel

from tiny import FILTER, count, write_baseline

CLUSTERS = {"ray": "ray", "dask": "distributed"}
KILL = ("open({log!r}, 'a').write('made\\n'); " "len(open({log!r}).readlines()) == 2 and os.kill(os.getpid(), 9)")
"""Estimator whose second instance kills its process."""


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


def errors(store):
    return {(result["method"], result["seed"]): result["step_errors"] for result in store.results()
            if result["status"] == "ok"}


@pytest.mark.cluster
@pytest.mark.parametrize("backend", CLUSTERS)
def test_a_cluster_continues_when_a_worker_is_killed(backend, tmp_path):
    """One of two workers is killed; in the end every episode is stored, with the scores of a run in this process."""
    pytest.importorskip(CLUSTERS[backend])
    log, store = tmp_path / "log", EpisodeStore(tmp_path / "results")
    path = write_baseline(tmp_path, init=KILL.format(log=str(log)), update="return Estimate(self.level + voltages[0])")
    jobs = [Job(FILTER, path, seed) for seed in (1, 2, 3, 4)]
    run_jobs(jobs, store, n_jobs=2, backend=backend)
    assert count(log) >= 5                                             # the killed worker's episode was started again
    assert errors(store) == {("mine", f"train:{job.seed}"): run_episode(job)[0]["step_errors"] for job in jobs}


@pytest.mark.cluster
def test_output_of_methods_in_ray_is_printed(tmp_path, capsys):
    """Output of methods in ray's workers, and in isolated processes started by them, is printed."""
    pytest.importorskip("ray")
    path = write_baseline(tmp_path, init="print('made')")
    run_jobs([Job(FILTER, path, 1), Job(FILTER, path, 2, "process")], EpisodeStore(tmp_path / "results"), n_jobs=2,
             backend="ray")
    assert capsys.readouterr().err.count("made\n") == 2


@pytest.mark.cluster
@pytest.mark.parametrize("backend", CLUSTERS)
def test_methods_are_isolated_in_a_cluster(backend, tmp_path):
    """A third-party file runs in a separate process of each worker."""
    pytest.importorskip(CLUSTERS[backend])
    store, path = EpisodeStore(tmp_path / "results"), write_baseline(tmp_path)
    jobs = [Job(FILTER, path, seed, "process") for seed in (1, 2)]
    run_jobs(jobs, store, n_jobs=2, backend=backend)
    assert all(result["peak_memory"] > 50e6 and result["run"]["isolation"] == "process" for result in store.results())
    assert errors(store) == {
        ("mine", f"train:{job.seed}"): run_episode(job._replace(isolation="none"))[0]["step_errors"] for job in jobs}


def test_without_a_cluster_a_killed_worker_ends_the_run_without_losses(tmp_path):
    """The message explains how to resume; the same run again runs only missing episodes."""
    log, store = tmp_path / "log", EpisodeStore(tmp_path / "results")
    path = write_baseline(tmp_path, init=KILL.format(log=str(log)))
    jobs = [Job(FILTER, path, seed) for seed in (1, 2, 3)]
    with pytest.raises(WorkerLostError, match="the same command resumes"):
        run_jobs(jobs, store, n_jobs=2)
    finished = len(errors(store))
    assert finished < 3
    before = count(log)
    run_jobs(jobs, store, n_jobs=2)
    assert len(errors(store)) == 3 and count(log) == before + 3 - finished


def test_unavailable_backends_are_reported(monkeypatch):
    """Unknown or missing backends have an error message."""
    with pytest.raises(ValueError, match="backend must be one of loky, ray, dask; got 'slurm'"):
        list(run_parallel(print, [(1,)], 1, "slurm"))
    with monkeypatch.context() as patch, pytest.raises(ModuleNotFoundError):
        patch.setattr(parallel, "_with_ray", lambda *_: iter(importlib.import_module("ray_is_not_here")))
        list(run_parallel(print, [(1,)], 1, "ray"))
    for backend, package in CLUSTERS.items():
        if not importlib.util.find_spec(package):
            with pytest.raises(ValueError, match=f"backend {backend} needs {package}, which the extra cluster"):
                list(run_parallel(print, [(1,)], 1, backend))
    assert set(BACKENDS) == {"loky", *CLUSTERS}


def test_loky_is_silent_when_it_renews_a_worker(recwarn):
    """Only this warning of loky is suppressed; the same text from other modules is not."""
    def warn(words, module):
        warnings.warn_explicit(words, UserWarning, "file.py", 1, module)

    loky = "joblib.externals.loky.process_executor"
    lost = ("A worker stopped while some jobs were given to the executor. This can be caused by a too short worker "
            "timeout or by a memory leak.")
    assert list(run_parallel(abs, [(-1,)], 1)) == [1]
    for words, module in ((lost, loky), ("something else", loky), (lost, "mine")):
        warn(words, module)
    assert [str(each.message) for each in recwarn] == ["something else", lost]
