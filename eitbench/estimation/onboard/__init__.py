"""Filters that run inside injection environments, and what a policy may believe of them."""
