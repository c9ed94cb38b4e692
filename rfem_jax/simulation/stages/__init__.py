"""The stages of a simulation.

stepping      one interval of the grid, by any method
integration   prepare, advance over all intervals, conclude
balances      energy, momentum and closure, and whether a run is accepted
conclusion    what a simulation ends with, and its arrays by name
"""
