"""Clearing of caches in memory."""

from eitbench.data import cache, episode_cache


def forget():
    """Clear the caches in memory of verified files, scoring constants and prefixes."""
    cache._sound.clear()
    episode_cache.scoring_constants.__wrapped__.cache_clear()
    episode_cache._prefix.cache_clear()
