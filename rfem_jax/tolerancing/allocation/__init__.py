"""The cheapest tolerances that keep the limits.

cost_models            cost of a tolerance
request                what is asked, checked
models                 approximate models that an allocation is solved on
statistical_criteria   limits that a share of the mechanisms keeps; worst_case_criterion: limits that all keep
allocation_study       the search and its verification
"""
