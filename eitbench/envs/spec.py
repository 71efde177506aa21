"""How long an episode is, said where agents look for it."""

from __future__ import annotations

from dataclasses import replace

from gymnasium.envs.registration import EnvSpec


class KnowsItsLength:
    """An environment in whose ``spec`` ``max_episode_steps`` is the steps of its episodes, also of
    a variant's.

    Nothing is cut off: the last step is ``terminated``, and no `gymnasium.wrappers.TimeLimit` is
    put around it. What is made from this very spec gets one, whose last step is ``truncated`` too
    (``gymnasium.make(spec, max_episode_steps=-1)`` leaves it out). So ids are registered without.
    """

    episode_steps: int
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """From what it was made; None before that."""
        return self._spec

    @spec.setter
    def spec(self, made_from: EnvSpec | None) -> None:
        self._spec = made_from and replace(made_from, max_episode_steps=self.episode_steps)
