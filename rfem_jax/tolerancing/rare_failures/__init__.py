"""Probabilities of rare failures.

subset             subset simulation: probabilities without gradients, and samples that fail
design_points      the most probable points at which a limit fails (FORM); searches: until these are all
importance         importance sampling about these points and where samples fail
limit_sampling     what samples say of each limit, and whether it can be trusted
failure_study      all of it for all limits of a problem; failure_result: what it found
"""
