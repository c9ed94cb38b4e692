"""Optimisers under bounds and constraints, and where they start."""
