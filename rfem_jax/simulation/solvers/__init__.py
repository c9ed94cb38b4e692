"""Integration methods as diffrax solvers.

explicit             Runge-Kutta, leapfrog; peaks of loads beside any explicit solver
implicit_step        one step of an implicit method, with its derivative
generalised_alpha    the implicit method
recorded_steps       a step-size controller that repeats the steps of another run
catalogue            from a method of the description to its solver; registration
"""
