"""Dimensions and tolerances found: the best of them that keep limits on metrics; the cheapest tolerances alone.

cost_models    cost of a tolerance
variables      what may change: dimensions (values) and tolerances (sizes)
request        what is asked, checked
observations   values and derivatives of the problem at many errors, kept for an interrupted search
criteria       limits at the perfect mechanism, in the worst case, by root sum of squares, at a yield
verification   a fresh run at the answer, and what it says of the limits
result         the answer
optimisation   `optimise`: several starts, a search on the problem itself (search), the corrections
front          answers for several weights of two objectives (Pareto)
allocation     `allocate`: without dimensions, a search on the quadratic model that observations correct
               (models, corrected_model; corrected_worst_case, corrected_statistics)
"""
