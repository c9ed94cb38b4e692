"""What is studied: values of errors, alone and in batches.

problem             what a tolerance problem is; any function as one
metrics             numbers of a run
simulated_problem   the simulator as a problem
distributions       of the errors within their tolerances
sample_values       values of many samples at once
evaluation          at points and along them; execution: in batches over devices; results_store: kept as it goes
linearisation       first derivatives at many points; reproduction: where pins strike, a finer step must have the same
quadratic_model     second-order expansions
"""
