"""The base of all reports on tasks.

Place in the pipeline: **task_report** -> the reports of all kinds -> catalogue; each task is computed, printed, written
and drawn. A kind of task from outside the package begins here too (`rfem_jax.task_kinds`).
"""

import abc
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from jax.typing import ArrayLike

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.metrics.catalogue import note_sentences
from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.description.tolerances.zones import SpecifiedZone
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.contents.overview import format_error
from rfem_jax.report.contents.tables import title_text
from rfem_jax.report.drawings.pictures import drawn, write_pictures
from rfem_jax.report.drawings.style import SETTINGS
from rfem_jax.report.tasks.task_files import write_task_json
from rfem_jax.report.terminal.messages import show
from rfem_jax.tolerancing.problems.kept_evaluations import kept_in
from rfem_jax.tolerancing.problems.results_store import count_chunks
from rfem_jax.tolerancing.problems.sharing import process_index

GRADIENT = 3.0  # simulations that one with first derivatives takes (benchmarks/gradients.py)

Asked = TypeVar("Asked", bound=Task)
Result = TypeVar("Result")


class TaskReport(abc.ABC, Generic[Asked, Result]):
    """One task of one study: how it is computed, printed, written and drawn.

    Args:
        study: as loaded, with this task.
        name: of the kind of task.
        task: what is asked.
    """

    def __init__(self, study: Study, name: str, task: Asked):
        self.study, self.name, self.task = study, name, task

    def require_folder(self, folder: Path) -> None:
        """See that `folder`, that of the command, can hold what `run` keeps there; asked before anything is computed,
        with a study whose method may still have to be chosen. Raises: InputError."""

    def trials(self) -> Mapping[str, ArrayLike] | None:
        """Assemblies by which "auto" chooses the step of this task, as `trials` of `Problem`; None: as for cases."""
        return None

    @abc.abstractmethod
    def run(self, folder: Path) -> Result:
        """Compute the result; `folder` is that of the command, for what a later run continues with.

        Raises: InputError for what cannot be computed.
        """

    def text(self, result: Result) -> str:
        """What is printed, without the title of the study."""
        return str(result)

    @abc.abstractmethod
    def write(self, folder: Path, result: Result) -> list[Path]:
        """Write the result into `folder`; returns the files. Raises: OSError."""

    def write_both(self, folder: Path, content: dict[str, Any], rows: list[dict[str, Any]]) -> list[Path]:
        """Write NAME.json, with what was asked for beside `content`, and NAME.csv of the rows. Raises: OSError."""
        return [
            write_task_json(folder / f"{self.name}.json", self.study, self.name, content),
            write_csv(folder / f"{self.name}.csv", rows),
        ]

    def draw(self, result: Result) -> dict[str, Figure]:
        """{name: picture}; the files are called "<name of the task>_<name>.png". None unless a kind has some."""
        return {}

    def succeeded(self, result: Result) -> bool:
        """Whether the result answers what was asked; otherwise the command ends with exit code 3."""
        return getattr(result, "status", "ok") == "ok"

    def text_of_helper(self, result: Result) -> str:
        """What is printed by all processes but the first, which do not write (a task shared by several)."""
        return f"Process {process_index()} is done."

    @property
    def tolerances(self) -> SpecifiedTolerances:
        """The tolerances of the study, which is not read without them where the task needs them."""
        found = self.study.tasks.tolerances
        if found is None:
            raise InputError(
                f"Task `{self.name}` must have tolerances, but the study gives none; add a table [tolerances]."
            )
        return found

    def settings(self) -> Iterator[tuple[str, str]]:
        """(name, text) of everything that is asked, but the metrics and what is left out, for `check`."""
        for one in fields(self.task):
            value = getattr(self.task, one.name)
            if one.name != "metrics" and value is not None and value != {} and value != ():
                yield one.name.replace("_", " "), self.setting_text(one.name, value)

    def setting_text(self, name: str, value: Any) -> str:
        """One setting in words; errors in deg and mm."""
        if name == "limits":
            return ", ".join(_limit(*item) for item in value.items())
        if name == "at":
            unit = partial(deviation_unit, self.study.mechanism)
            return ", ".join(format_error(error, one, unit(error)) for error, one in value.items())
        if name == "zones":
            return ", ".join(_zone(one) for one in value)
        if isinstance(value, dict):
            return ", ".join(f"{key} {item}" for key, item in value.items())
        if isinstance(value, tuple):
            return ", ".join(f"{item:g}" if isinstance(item, (int, float)) else str(item) for item in value)
        if isinstance(value, bool):
            return "yes" if value else "no"
        return f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")

    def simulations(self) -> list[str]:
        """How many simulations the task needs, in words, for `check`; none where it is not known beforehand."""
        return []

    def work(self) -> float | None:
        """How many simulations take about as long as the task, at most; None where it is not known beforehand."""
        return None

    def pictures(self, result: Result) -> dict[str, Figure]:
        """All pictures by their files' names without ending."""
        from matplotlib import rc_context

        with rc_context(SETTINGS):
            return {f"{self.name}_{what}": figure for what, figure in self.draw(result).items()}

    def unfinished(self, folder: Path) -> Path:
        """Where the evaluations of an interrupted run are kept."""
        return folder / f"{self.name}.unfinished"

    def left(self, folder: Path) -> str:
        """What an interrupted run has left for the next one, in words; "" for nothing."""
        count = count_chunks(self.unfinished(folder))
        return f"{count} evaluations are kept in {self.unfinished(folder)}" if count else ""

    def do(self, folder: Path, pictures: bool = True) -> tuple[bool, list[Path]]:
        """Compute, print, write and, with `pictures`, draw; returns whether it succeeded, and the files written."""
        with kept_in(self.unfinished(folder)):
            result = self.run(folder)
        good = self.succeeded(result)
        if process_index() != 0:
            show(self.text_of_helper(result))
            return good, []
        said = self.text(result)  # results of this package have the notes on their own metrics
        notes = [one for one in note_sentences(getattr(self.task, "metrics", ())) if one.split()[0] not in said]
        show("\n\n".join([title_text(self.study), said, *notes]), end="\n\n")
        written = self.write(folder, result)
        if pictures:
            written += drawn(lambda: write_pictures(folder, self.pictures(result)))
        return good, written


def _zone(zone: SpecifiedZone) -> str:
    over = "" if zone.length is None else f" over {format_error('', zone.length, 'm').removeprefix(' = ')}"
    return f"{zone.name} a {'disc' if zone.zone == 'cylinder' and zone.length is None else zone.zone}{over}"


def _limit(name: str, pair: tuple[float, float]) -> str:
    low, high = pair
    if not math.isfinite(low):
        return f"{name} <= {high:g}"
    return f"{name} >= {low:g}" if not math.isfinite(high) else f"{low:g} <= {name} <= {high:g}"


def as_stage(stage: str) -> Callable[[int, int], None]:
    """Begin a stage, and return the function (done, total) by which a study tells how far it is."""
    on_stage(stage)
    return lambda done, total: on_stage(stage, done / total)
