"""Floor 8: learning to choose injections (extra ``rl``)."""
