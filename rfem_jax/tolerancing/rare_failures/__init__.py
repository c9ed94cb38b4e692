"""Probabilities of rare failures.

design_points      the most probable points at which a limit fails (FORM)
importance         importance sampling about these points
failure_study      both for all limits of a problem; failure_result: what it found
"""
