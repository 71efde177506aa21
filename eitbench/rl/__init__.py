"""Training of injection policies by reinforcement learning (layer 8; extra ``rl``)."""
