"""The base of the reports on tasks whose samples are kept in a folder, where an interrupted run continues.

Place in the pipeline: task_report -> **sampled_report** -> monte_carlo, sweep.
"""

import abc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

from rfem_jax.compilation import keys
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.tasks.task_report import Asked, Result, TaskReport
from rfem_jax.tolerancing.problems.results_store import StudyFolderError, count_chunks
from rfem_jax.tolerancing.problems.sharing import process_index
from rfem_jax.tolerancing.sampling.sampled_studies import SampleStudy


class SampledReport(TaskReport[Asked, Result]):
    """A task of many samples; its result has the numbers `good` of them and `chunks_computed`."""

    words: ClassVar[tuple[str, str]]  # the study and its samples, in a sentence

    @abc.abstractmethod
    def samples(self) -> SampleStudy:
        """What is sampled, by which its folder is known before there is a problem."""

    def require_folder(self, folder: Path) -> None:
        task: Any = self.task  # with metrics
        with self.folder_in_words(folder):
            self.samples().require_folder(folder / self.name, task.metrics, describe_study(self.study))

    @contextmanager
    def folder_in_words(self, folder: Path) -> Iterator[None]:
        """In which a folder that cannot be used is refused in the words of the command line."""
        study, samples = self.words
        try:
            yield
        except StudyFolderError as problem:
            raise InputError(
                f"Argument `--out` must be a folder in which this {study} can start or continue, but "
                f"{problem.finding}; choose another folder, specify the same study, or remove `{folder / self.name}` "
                f"and its {samples}."
            ) from None

    def kept_as(self, folder: Path) -> dict[str, Any]:
        """Arguments of the study that keep its chunks in a folder of their own, with what its problem is made of."""
        return {"resume": folder / self.name, "description": describe_study(self.study)}

    def left(self, folder: Path) -> str:
        count = count_chunks(folder / self.name)
        return f"{count} chunks of {self.words[1]} are kept in {folder / self.name}" if count else super().left(folder)

    def succeeded(self, result: Any) -> bool:
        return result.good > 0

    def text_of_helper(self, result: Any) -> str:
        return f"Process {process_index()} computed {result.chunks_computed} chunks."


def describe_study(study: Study) -> dict[str, str]:
    """Digests of what the problem of a study is made of, {name: digest}, without those of which none is known (with a
    function of the user): known before a model is built."""
    method = study.method if study.asked_method is None else study.asked_method
    parts = {"mechanism": study.mechanism, "drive": study.drive}
    parts["simulation"] = (study.duration, method, study.save_every)
    if study.statics is not None:
        parts["statics"] = study.statics
    found = {}
    for name, part in parts.items():
        with suppress(keys.NotDigestible):
            found[name] = keys.digest_value(part)
    return found
