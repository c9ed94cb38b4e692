"""Small vibrations: natural frequencies, and the largest stable step, which follows from them.

vibration_matrices   mass and stiffness of the perfect mechanism at rest
vibration            its modes, for limits of the step
stability            the largest stable step of a method
modes                natural frequencies about assembled configurations, differentiable
"""
