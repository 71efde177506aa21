"""A world, a method and a score for eitbench, from outside."""
