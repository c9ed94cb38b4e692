"""Static equilibrium: the assembled start state and its preload.

tangent     of the static equations, by recursion over the links
search      Newton's method, and the linear equations of the derivatives
static_equations      what is zero at rest, as flat arrays
settling    the equilibrium, its derivatives and status; equilibrium_stability
assembly    start state and preload for the user, loads at rest
designs     a model with other numbers; start_closure: its loops closed anew
traced_descriptions   models of descriptions with traced numbers
"""
