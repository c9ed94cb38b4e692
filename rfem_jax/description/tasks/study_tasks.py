"""The tolerances of a study and its tasks.

Place in the pipeline: made of a study file's tables by `study.load_study`, or in Python; `study` checks them against
its mechanism, `rfem_jax.report.tasks` does them. The kinds are those of `rfem_jax.task_kinds`.
"""

from dataclasses import dataclass
from typing import Any

from rfem_jax.description.basics.errors import ChecksItself, InputError, Problems, suggestion
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.deviations import require_sizes
from rfem_jax.description.tasks.catalogue import asked_classes
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances, read_tolerances
from rfem_jax.task_kinds import task_kinds


@dataclass(frozen=True, init=False)
class Tasks(ChecksItself):
    """The tolerances of a study, and what is asked about them; `tasks.NAME` is one task, None where it is not asked.

    Args:
        tolerances: SpecifiedTolerances, or None.
        asked: tasks by their names, such as monte_carlo=MonteCarloTask(64, ("D.rms_moment",)).
    Raises:
        InputError: a name is of no kind of task, or a task of another kind.
    """

    tolerances: SpecifiedTolerances | None
    asked: dict[str, Task]

    def __init__(self, tolerances: SpecifiedTolerances | None = None, **asked: Task | None):
        kinds = asked_classes()
        problems = []
        for name, task in asked.items():
            if name not in kinds:
                problems.append(
                    f"Argument `{name}` must be a kind of task, but there is no such kind; {suggestion(name, kinds)}"
                )
            elif task is not None and not isinstance(task, kinds[name]):
                problems.append(f"Argument `{name}` must be a {kinds[name].__name__}, but was {task!r}; make one.")
        if problems:
            raise InputError(*problems)
        found = {name: asked[name] for name in kinds if asked.get(name) is not None}
        object.__setattr__(self, "tolerances", tolerances)
        object.__setattr__(self, "asked", found)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "asked" or name not in task_kinds():
            raise AttributeError(f"a study has no task {name!r}")
        return self.asked.get(name)

    @property
    def declared(self) -> tuple[str, ...]:
        """Names of the tasks that there are, in the order in which they are done."""
        return tuple(self.asked)

    def resolved(self, mechanism: Mechanism) -> "Tasks":
        """The same tasks with "*" replaced by the mechanism's joints; everything must fit it.

        Raises: InputError for errors and joints that the mechanism has not, and for a task that
            needs tolerances where there are none.
        """
        found, problems = {}, Problems()
        with problems.noted():
            if self.tolerances is not None:
                require_sizes(mechanism, self.tolerances.reaches(), "`tolerances`")
        for name, task in self.asked.items():
            with problems.noted():
                if self.tolerances is None and task.needs_tolerances:
                    raise InputError(
                        f"Task `{name}` must have tolerances of the errors, but the study specifies none; "
                        'add a table [tolerances], for example with "D.delta_x" = "0.5 deg".'
                    )
                found[name] = task.resolved(mechanism, name)
        problems.refuse()
        return Tasks(self.tolerances, **found)


def read_tasks(content: dict[str, Any]) -> Tasks:
    """Return the Tasks of a study file's content; tables that are missing give no task.

    Raises: InputError, with the table's name, for unknown keys and bad values.
    """
    tolerances, found, problems = None, {}, Problems()
    with problems.noted():
        tolerances = read_tolerances(content["tolerances"]) if "tolerances" in content else None
    for name, kind in asked_classes().items():
        with problems.noted():
            if name in content:
                found[name] = kind.read(content[name], f"[{name}]", tolerances)
    problems.refuse()
    return Tasks(tolerances, **found)
