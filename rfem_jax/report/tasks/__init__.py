"""How each kind of task is computed, printed, written and drawn: one file a kind.

    task_report     the base of all, and the order in which a task is done
    sampled_report  the base of those whose samples are kept: monte_carlo, sweep
    catalogue       the class of every kind; a task of a study is done
    study_problem   the study's mechanism as a problem of the tolerance studies
    task_files      what their JSON files have in common
    solution_report what allocation and optimise have in common
    sensitivity, monte_carlo, worst_case, allocation, optimise, sweep, reliability, identification

Place in the pipeline: `report.commands` does the tasks that a study declares; `rfem_jax.task_kinds` lists the kinds.
"""
