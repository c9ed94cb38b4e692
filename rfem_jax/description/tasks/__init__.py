"""What a study may ask about its tolerances: one file a kind of task.

    task            the base of all: how a table is read, how it is checked against the mechanism
    settings        what several kinds share: metrics, limits, starts, numbers
    sensitivity, monte_carlo, worst_case, allocation, optimise, sweep, reliability, identification
    costs           bounds and costs of tolerances that are to be found
    catalogue       the class of every kind that `rfem_jax.task_kinds` lists
    study_tasks     the tolerances and tasks of one study

Place in the pipeline: `study` holds the tasks; `rfem_jax.report.tasks` does and shows them.
"""

from rfem_jax.description.tasks.allocation import AllocationTask, ErrorCost
from rfem_jax.description.tasks.identification import IdentificationTask
from rfem_jax.description.tasks.monte_carlo import MonteCarloTask
from rfem_jax.description.tasks.optimise import OptimiseTask
from rfem_jax.description.tasks.reliability import ReliabilityTask
from rfem_jax.description.tasks.sensitivity import SensitivityTask
from rfem_jax.description.tasks.study_tasks import Tasks
from rfem_jax.description.tasks.sweep import SweepTask
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tasks.worst_case import WorstCaseTask

__all__ = [
    "AllocationTask",
    "ErrorCost",
    "IdentificationTask",
    "MonteCarloTask",
    "OptimiseTask",
    "ReliabilityTask",
    "SensitivityTask",
    "SweepTask",
    "Task",
    "Tasks",
    "WorstCaseTask",
]
