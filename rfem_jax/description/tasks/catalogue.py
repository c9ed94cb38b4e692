"""The class of what is asked, for every kind of task.

Place in the pipeline: the tasks, `rfem_jax.task_kinds` -> **catalogue** -> study_tasks, key_reference.
"""

from rfem_jax.description.tasks.allocation import AllocationTask
from rfem_jax.description.tasks.identification import IdentificationTask
from rfem_jax.description.tasks.monte_carlo import MonteCarloTask
from rfem_jax.description.tasks.optimise import OptimiseTask
from rfem_jax.description.tasks.reliability import ReliabilityTask
from rfem_jax.description.tasks.sensitivity import SensitivityTask
from rfem_jax.description.tasks.sweep import SweepTask
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tasks.worst_case import WorstCaseTask
from rfem_jax.task_kinds import task_kinds

_ASKED: dict[str, type[Task]] = {
    "sensitivity": SensitivityTask,
    "monte_carlo": MonteCarloTask,
    "worst_case": WorstCaseTask,
    "allocation": AllocationTask,
    "sweep": SweepTask,
    "reliability": ReliabilityTask,
    "optimise": OptimiseTask,
    "identification": IdentificationTask,
}


def asked_classes() -> dict[str, type[Task]]:
    """{name of a kind: class of what is asked}, in the order of `task_kinds`."""
    return {name: _ASKED.get(name) or kind.asked_class() for name, kind in task_kinds().items()}
