"""What a simulation returns, and what it records on the way.

observation     what is recorded of an instant
records         what is recorded beside it where a metric asks for it
run             the result
quantities      names, units and labels of what a run has
labelled_runs   runs as Datasets, tables and HTML
axes_of_loads   loads in other axes
remarks         what a person should know of a run that is right
"""
