"""Monte Carlo studies.

sequences            random and Sobol' points
statistics           estimates with confidence intervals
monte_carlo_study    scatter, yield, Sobol' indices; monte_carlo_result: what it found
study_identity       what a folder of samples belongs to
"""
