"""Third-party package for eitbench with a world, a method and a score."""
