"""Data for people who learn: episodes as examples, for numpy and torch, and as files."""
