"""Integration methods as diffrax solvers.

explicit             Runge-Kutta, leapfrog; peaks of loads beside any explicit solver
implicit_step        one step of an implicit method, with its derivative
newmark_formulas     what a step of the implicit method makes of accelerations
step_boundaries      what it remembers at its start, and finds at its end
generalised_alpha    the implicit method; contact_steps: its steps in parts that follow contacts
recorded_steps       a step-size controller that repeats the steps of another run
catalogue            from a method of the description to its solver; registration
"""
