"""Vectors, rotations and what matrices need: the bottom of the mechanics.

vectors             vectors, rotations, spatial vectors; linear equations
products            sums of products, each one operation to JAX
reordering          rows exchanged, repeated, summed, each one operation to JAX
derivative_rules    derivatives of what is found by a search
block_tridiagonal   equations of a chain of blocks
"""
