"""What is studied: values of errors, alone and in batches.

problem             what a tolerance problem is; any function as one
metrics             numbers of a run
simulated_problem   the simulator as a problem
distributions       of the errors within their tolerances
evaluation          at points and along them; execution: in batches over devices; results_store: kept as it goes
quadratic_model     second-order expansions
"""
