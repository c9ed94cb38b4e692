"""The base of all tasks: a table of a study file as a checked object.

Place in the pipeline: settings -> **task** -> sensitivity, monte_carlo, worst_case, allocation; a kind of task from
outside the package begins here too (`rfem_jax.task_kinds`).
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from rfem_jax.description.deviations import require_deviation
from rfem_jax.description.errors import ChecksItself, InputError, Problems, suggestion
from rfem_jax.description.joint_kinds import KINDS
from rfem_jax.description.joints import Joint
from rfem_jax.description.mechanism import Mechanism
from rfem_jax.description.metric_catalogue import RUN_METRICS, has_metric
from rfem_jax.description.tables import build, checked_table, keys_of
from rfem_jax.description.tolerances import SpecifiedTolerances


@dataclass(frozen=True)
class Task(ChecksItself):
    """What is asked of one kind of task: a frozen dataclass whose fields are the keys of its table.

    Four names of fields have a meaning for all kinds: `metrics` (a tuple of names) and `limits` (a dict by name) may
    have "*" for all joints; `at` and `bounds` (dicts by name) hold assembly errors, which the mechanism must have.
    """

    needs_tolerances: ClassVar[bool] = True

    @classmethod
    def tables(cls, header: str) -> list[tuple[str, type, Collection[str], Collection[str]]]:
        """The tables of a study file, for `rfem-jax keys`: (header, class whose arguments are the keys, required keys,
        optional keys)."""
        return [(header, cls, *keys_of(cls))]

    @classmethod
    def read(cls, table: object, place: str, tolerances: SpecifiedTolerances | None) -> "Task":
        """The task of its `table`, which stands at `place` ("[name]") of a study file with these tolerances.

        Raises: InputError for unknown and missing keys and bad values.
        """
        problems = Problems()
        settings = problems.usable(lambda: checked_table(table, place, *keys_of(cls)))
        return build(cls, settings, place, problems)

    def resolved(self, mechanism: Mechanism, name: str) -> "Task":
        """The same task, called `name`, with "*" replaced by the mechanism's joints.

        Raises: InputError for errors and joints that the mechanism has not.
        """
        problems = Problems()
        for error in (*getattr(self, "at", ()), *getattr(self, "bounds", ())):
            with problems.noted():
                require_deviation(mechanism, error, f"`{name}`")
        own = {one.name: getattr(self, one.name) for one in fields(self)}
        patterns = (*own.get("limits", ()), *own.get("metrics", ()))
        metrics: dict[str, list[str]] = {}
        for pattern in patterns:
            with problems.noted():
                metrics[pattern] = _resolve(pattern, mechanism.joints, name)
        problems.refuse()
        changes: dict[str, Any] = {}
        if "limits" in own:
            changes["limits"] = {
                metric: limit for pattern, limit in own["limits"].items() for metric in metrics[pattern]
            }
        if "metrics" in own:
            changes["metrics"] = tuple(dict.fromkeys(one for pattern in own["metrics"] for one in metrics[pattern]))
        return replace(self, **changes)


def _resolve(pattern: str, joints: Iterable[Joint], task: str) -> list[str]:
    """Names of the metrics that one name with "*" stands for, of all joints that have it; the joint must be there."""
    joint, _, kind = pattern.rpartition(".")
    names = {one.name: has_metric(kind, KINDS[one.kind], one.cut) for one in joints}
    if joint == "*" and any(names.values()):
        return [f"{name}.{kind}" for name, has in names.items() if has]
    if pattern not in RUN_METRICS and joint not in (*names, "*"):
        raise InputError(
            f"Argument `metrics` of the task `{task}` must be of joints of the mechanism, but "
            f"`{joint}` in `{pattern}` is none; {suggestion(joint, names)}"
        )
    if pattern not in RUN_METRICS and not names.get(joint):
        having = [name for name, has in names.items() if has]
        raise InputError(
            f"Argument `metrics` of the task `{task}` must be of joints that have them, but `{pattern}` is not: a cut "
            f"joint has no coordinate, and one of another kind not this one; "
            + (f"joints that have it are {', '.join(having)}." if having else "no joint has it, leave it out.")
        )
    return [pattern]
