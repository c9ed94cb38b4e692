"""Static equilibrium: the assembled start state and its preload.

tangent     of the static equations, by recursion over the links
search      Newton's method, and the linear equations of the derivatives
assembly    equilibrium, its derivatives, loads and status
designs     a model with other numbers; start_closure: its loops closed anew
traced_descriptions   models of descriptions with traced numbers
"""
