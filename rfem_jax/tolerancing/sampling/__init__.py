"""Monte Carlo studies.

sequences            random and Sobol' points
statistics           estimates with confidence intervals
monte_carlo_study    scatter, yield, Sobol' indices; monte_carlo_result: what it found
sampled_studies      studies of samples, of sweeps too: what identifies them, and how they are run
"""
