"""The base of all tasks: a table of a study file as a checked object.

Place in the pipeline: settings -> **task** -> sensitivity, monte_carlo, worst_case, allocation; a kind of task from
outside the package begins here too (`rfem_jax.task_kinds`).
"""

from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from rfem_jax.description.basics.errors import ChecksItself, Problems
from rfem_jax.description.basics.tables import keys_of, read_table
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.metrics.subjects import require_metric, subjects_of
from rfem_jax.description.parameters.deviations import require_deviation, require_zone
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances


@dataclass(frozen=True)
class Task(ChecksItself):
    """What is asked of one kind of task: a frozen dataclass whose fields are the keys of its table.

    Four names of fields have a meaning for all kinds: `metrics` (a tuple of names) and `limits` (a dict by name)
    may have "*" for all joints or links; `at` and `bounds` (dicts by name) hold assembly errors, which the mechanism
    must have.
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
        return read_table(cls, table, place)

    def resolved(self, mechanism: Mechanism, name: str) -> "Task":
        """The same task, called `name`, with "*" replaced by the mechanism's joints.

        Raises: InputError for errors and joints that the mechanism has not.
        """
        problems = Problems()
        zones = {zone.name: zone for zone in getattr(self, "zones", ())}
        for error in (*getattr(self, "at", ()), *getattr(self, "bounds", ())):
            with problems.noted():
                if error in zones:
                    require_zone(mechanism, zones[error], f"`{name}`")
                else:
                    require_deviation(mechanism, error, f"`{name}`")
        own = {one.name: getattr(self, one.name) for one in fields(self)}
        patterns = (*own.get("limits", ()), *own.get("metrics", ()))
        metrics: dict[str, tuple[str, ...]] = {}
        subjects = subjects_of(mechanism)
        for pattern in patterns:
            with problems.noted():
                metrics[pattern] = require_metric(pattern, subjects, "mechanism", f" of the task `{name}`")
        problems.refuse()
        changes: dict[str, Any] = {}
        if "limits" in own:
            changes["limits"] = {
                metric: limit for pattern, limit in own["limits"].items() for metric in metrics[pattern]
            }
        if "metrics" in own:
            changes["metrics"] = tuple(dict.fromkeys(one for pattern in own["metrics"] for one in metrics[pattern]))
        return replace(self, **changes)
