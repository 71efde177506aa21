"""Command line (layer 9)."""
