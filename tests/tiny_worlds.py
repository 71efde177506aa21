"""The thesis' pipe with episodes of a third of a second."""

from eitbench.data.episodes import cached_truth_model
from eitbench.worlds.catalogue import PIPE_2D
from eitbench.worlds.random_streams import episode_streams

from short import FAST

TINY = PIPE_2D.with_changes(FAST)


def truths(world, *seeds):
    """Simulate the concentrations and velocities of episodes together, without voltages."""
    streams = [episode_streams(seed) for seed in seeds]
    return list(world.target.evolve(world, streams, cached_truth_model(world), lambda _: None, world.n_steps))
