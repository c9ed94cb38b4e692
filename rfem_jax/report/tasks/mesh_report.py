"""How far the loads of a study's cases are from those of many rigid finite elements.

Place in the pipeline: study -> `tolerancing.refinement` -> **mesh_report** -> `rfem-jax check --converge`.
"""

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.study_file.study import Study
from rfem_jax.labelled_data import text_of
from rfem_jax.mechanics.statics.designs import model_of_study
from rfem_jax.report.contents.summary import joint_names
from rfem_jax.report.tasks.study_problem import build_problem, stable_when_refined
from rfem_jax.report.tasks.task_report import as_stage
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.problems.static_problem import StaticProblem
from rfem_jax.tolerancing.refinement import Mesh, MeshConvergence, mesh_convergence

FINEST = 4.0  # sdes of the finest mesh over those of the study, nearly always


def study_convergence(study: Study, accuracy: float) -> MeshConvergence:
    """The loads in all joints, and what else the study and its tasks report, of its cases on finer and finer links; RMS
    loads of simulations, the largest ones of a mechanism at rest. Raises InputError for rigid links, and a study that
    simulates nothing."""
    if not any(link.flexible for link in study.mechanism.links):
        raise InputError(
            "Argument `--converge` must be of a study with flexible links, but all links are rigid, and exact: there "
            "are no rigid finite elements to refine."
        )
    kinds = ("rms_force", "rms_moment") if study.statics is None else ("max_force", "max_moment")
    loads = [f"{joint}.{kind}" for joint in joint_names(study) for kind in kinds]
    of_tasks = [one for task in study.tasks.asked.values() for one in getattr(task, "metrics", ())]
    metrics = list(dict.fromkeys((*loads, *study.metrics, *of_tasks)))
    at_rest = study.statics is not None
    study = study if at_rest else stable_when_refined(study, FINEST)

    def make(rfes: Mesh | None) -> Problem | StaticProblem:
        return build_problem(study, metrics, model_of_study(study, at_rest, rfes))

    cases = {case.name: case.errors for case in study.cases}
    return mesh_convergence(make, cases, accuracy=accuracy, progress=as_stage("Comparing numbers of rfes"))


def convergence_text(found: MeshConvergence) -> str:
    """Tables and sentences."""
    return text_of(found.parts())


def convergence_document(found: MeshConvergence) -> dict[str, object]:
    """For `--json`."""
    return {
        "accuracy": found.accuracy,
        "rfes": found.rfes,
        "wanted_rfes": found.rfes_for(),
        "metrics": found.rows(),
    }
