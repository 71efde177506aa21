"""Runs on a cluster give the same records as local runs, also if a worker is killed.

Tests of ray and dask need the extra cluster: `pip install -c constraints.txt -e '.[test,cluster]'`, then `python -m
pytest -m cluster`.
"""

import pytest
from eitbench.bench.run import Job, run_episode, run_jobs
from eitbench.bench.store import EpisodeStore
from eitbench.data import parallel
from eitbench.data.parallel import WorkerLostError, run_parallel

from tiny import FILTER, count, write_baseline

CLUSTERS = {"ray": "ray", "dask": "distributed"}
KILL = "open({log!r}, 'a').write('made\\n'); len(open({log!r}).readlines()) == 2 and os.kill(os.getpid(), 9)"
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
@pytest.mark.parametrize("backend", CLUSTERS)
def test_methods_are_isolated_in_a_cluster(backend, tmp_path, capsys):
    """A third-party file runs in a separate process of each worker; ray's workers print its output here."""
    pytest.importorskip(CLUSTERS[backend])
    store, path = EpisodeStore(tmp_path / "results"), write_baseline(tmp_path, init="print('made')")
    jobs = [Job(FILTER, path, 1), Job(FILTER, path, 2, "process")]
    run_jobs(jobs, store, n_jobs=2, backend=backend)
    assert capsys.readouterr().err.count("made\n") == 2 or backend == "dask"
    assert [(result["peak_memory"] or 0) > 50e6 for result in store.results()] == [False, True]
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
    """Unknown or missing backends have an error message, but not a missing module of the task."""
    with pytest.raises(ValueError, match="backend must be one of loky, ray, dask; got 'slurm'"):
        list(run_parallel(print, [(1,)], 1, "slurm"))
    for missing, error, message in (("ray", ValueError, "backend ray needs ray, which the extra cluster"),
                                    ("mine", ModuleNotFoundError, "mine")):
        def fail(*_, missing=missing):
            raise ModuleNotFoundError(f"No module named {missing}", name=missing)

        monkeypatch.setattr(parallel, "_with_ray", fail)
        with pytest.raises(error, match=message):
            list(run_parallel(print, [(1,)], 1, "ray"))
