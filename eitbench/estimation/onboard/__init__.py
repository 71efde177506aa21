"""Filters inside injection environments, and the belief that policies derive from them."""
