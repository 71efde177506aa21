"""Floor 3: what is simulated once and kept: episodes, recordings, and the seeds that name them."""
