"""What is asked of a sweep: metrics over ranges of errors; the table [sweep].

Place in the pipeline: task -> **sweep** -> `rfem_jax.report.tasks.sweep`.

Symbols: bounds and `at` in m and rad, or strings with a unit.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from rfem_jax.description.basics.errors import Checks, InputError, Problems, require_choice
from rfem_jax.description.tasks.settings import (
    MOST_AT_ONCE,
    MOST_SAMPLES,
    convert_all,
    metric_names,
    whole_number,
)
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances, error_quantities


@dataclass(frozen=True)
class SweepTask(Task):
    """Metrics on a design of experiments, and the quadratic surface through them.

    Args:
        metrics: names of metrics; "*" stands for all joints.
        bounds: {error: (low, high)} in rad and m; in a study file the tolerances unless given.
        at: {error: value} in rad and m of errors held fixed; errors not named are 0.
        design: "grid", all combinations of some levels of every error, or "sobol", points that fill the ranges.
        levels: values of each error on a grid, at least 2.
        n: number of Sobol' points; best a power of 2.
        seed: of the Sobol' points.
        batch: points in a chunk, the unit that is stored, and lost when a run is interrupted.
        lanes: points that each device computes at once; None for its default.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    needs_tolerances = False

    metrics: tuple[str, ...]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    at: dict[str, float] = field(default_factory=dict)
    design: str = "grid"
    levels: int = 5
    n: int = 128
    seed: int = 0
    batch: int = 64
    lanes: int | None = None

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("metrics", metric_names)
        checks.convert("bounds", bounds_of)
        checks.convert("at", error_quantities, "at")
        checks.convert("design", require_choice, ("grid", "sobol"), "design")
        convert_all(checks, ("levels", "n"), whole_number, 2, MOST_SAMPLES)
        convert_all(checks, ("batch", "lanes"), whole_number, 1, MOST_AT_ONCE)
        convert_all(checks, ("seed",), whole_number, 0)
        checks.relation(("bounds", "at"), self._require_fixed)
        checks.relation(("bounds", "design", "levels"), self._require_few)

    def _require_fixed(self) -> None:
        for name in self.at:
            if name in self.bounds:
                raise InputError(
                    f"Argument `at` must hold errors that do not vary, but `{name}` varies; remove it from `at`."
                )

    def _require_few(self) -> None:
        count = self.levels ** len(self.bounds) if self.design == "grid" else 0
        if count > MOST_SAMPLES:
            raise InputError(
                f"Argument `levels` must give at most {MOST_SAMPLES} points, but {self.levels} levels of "
                f'{len(self.bounds)} errors are more; take fewer, or design = "sobol".'
            )

    @classmethod
    def read(cls, table: object, place: str, tolerances: SpecifiedTolerances | None) -> "SweepTask":
        """As `Task.read`, with the tolerances as bounds where none are given."""
        task: Any = super().read(table, place, tolerances)
        if task.bounds:
            return task
        if tolerances is None:
            raise InputError(
                f"{place}: Argument `bounds` must be given where there are no tolerances, but is missing; write for "
                'example bounds = { "D.delta_x" = ["-0.5 deg", "0.5 deg"] }.'
            )
        widths = tolerances.half_widths()
        ends = {name: (-width, width) for name, width in widths.items()}
        ends |= {one.error: one.interval for one in tolerances.independent}
        return replace(task, bounds={name: pair for name, pair in ends.items() if name not in task.at})


def bounds_of(bounds: Any, what: str = "bounds") -> dict[str, tuple[float, float]]:
    """{error: (low, high)} in rad and m, of pairs of numbers or strings with a unit; what: the
    argument that they are. Raises InputError."""
    if not isinstance(bounds, dict):
        raise InputError(
            f"Argument `{what}` must be a table of errors and their ranges, but was {bounds!r}; "
            'write for example { "D.delta_x" = ["-0.5 deg", "0.5 deg"] }.'
        )
    found, problems = {}, Problems()
    for name, pair in bounds.items():
        with problems.noted():
            if not isinstance(pair, (list, tuple)) or len(pair) != 2:
                raise InputError(
                    f"Argument `{what}` must give [low, high], but `{name}` has {pair!r}; "
                    'write for example ["-0.5 deg", "0.5 deg"].'
                )
            low, high = (error_quantities({name: end}, what)[name] for end in pair)
            if not low < high:
                raise InputError(
                    f"Argument `{what}` must rise from low to high, but `{name}` has {pair!r}; swap its ends."
                )
            found[name] = (low, high)
    problems.refuse()
    return found
