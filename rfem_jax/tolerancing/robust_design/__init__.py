"""Dimensions and tolerances found together: the best of them that keep limits on metrics.

variables      what may change: dimensions (values) and tolerances (half-widths), scaled to the unit cube
observations   values and derivatives of the problem at many errors, kept for an interrupted search
criteria       limits at the perfect mechanism, in the worst case, by root sum of squares, at a yield
search         sequential quadratic programming, conditions of optimality, the nearest to infeasible limits
verification   a fresh run at the answer
optimisation   `optimise`: several starts, the search, the corrections, the result
front          answers for several weights of two objectives (Pareto)
"""
