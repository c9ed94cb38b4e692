"""What is studied: values of errors, alone and in batches.

problem             what a tolerance problem is; any function as one
metrics             numbers of a run
simulated_problem   the simulator as a problem; static_problem: a mechanism at rest; mechanism_problem: what both have
distributions       of the errors within their tolerances
sample_values       values of many samples at once
evaluation          at points, and the loop that fills programs; execution: in chunks, over devices and processes
results_store       a folder of chunks; kept_evaluations: of all that an interrupted study has evaluated
linearisation       first derivatives at many points; reproduction: where pins strike, a finer step must have the same
quadratic_model     second-order expansions
"""
