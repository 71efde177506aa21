"""Floor 5: run baselines on environments, keep what came out, and report it."""
