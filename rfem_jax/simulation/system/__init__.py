"""What is integrated: the first-order system, what drives it, and the grid of times.

driving         which joint coordinates drives act on
time_grid       intervals between saved times and jumps, divided into steps
equations       the first-order system
stabilisation   Baumgarte's gains
sampled_laws    the user's own functions of time, by their values
batches         the same batch axes in functions with rules of their own
"""
