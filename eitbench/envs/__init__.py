"""Floor 5: the Gymnasium environments: a class a track, not a class a world."""
