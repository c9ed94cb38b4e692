"""Designs of experiments: metrics over ranges of the errors.

sweep_study         metrics on a grid or at Sobol' points
response_surface    quadratic polynomials fitted to them, with their cross-validated error
"""
