"""Layer 5: Gymnasium environments, one class per track, for all worlds."""
