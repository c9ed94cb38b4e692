"""What a study will cost, before it is run: numbers of simulations by task, memory of the results, and roughly the
time; part of `check`.

Place in the pipeline: after `load_study`; computes nothing.
"""

import math

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.forces import JointFriction
from rfem_jax.description.study_file.study import Study
from rfem_jax.task_kinds import task_kinds
from rfem_jax.text_layout import size_text, time_text, wrap_lines

SAVED_BY_DEFAULT = 500  # intervals, as `rfem_jax.simulation.system.time_grid` has them
BYTES = 8  # of a number in double precision
# On a core as that of benchmarks/README.md: of a step of Runge-Kutta 4 or of the implicit method, for each rfe or rigid
# link, alone or in a batch; of a static start. Other methods, links and machines differ by a small factor.
STEP_SECONDS, START_SECONDS = 6e-7, 2e-3


def cost_text(study: Study) -> str:
    """Simulations and results of the cases, and the simulations of every task, a line each."""
    lines = ["Cost"]
    if study.duration is not None:
        cases, times, steps = len(study.cases), saved_times(study), study.method.step
        length = "" if steps is None else f" of {_count(round(study.duration / steps), 'step')}"
        lines.append(
            f"  cases: {_count(cases, 'simulation')}{length}, computed together; results at {times} saved times, about "
            f"{size_text(BYTES * cases * times * numbers_saved(study))}"
        )
    if study.statics is not None:
        lines.append("  at rest: milliseconds for a case, or for a sample, which tasks call a simulation")
    if study.tasks.declared:
        # Takes seconds: only where there is something to count.
        from rfem_jax.report.tasks.catalogue import report_on

        for name in study.tasks.declared:
            told = report_on(study, name).simulations() or ["not known beforehand"]
            lines.append(f"  {(task_kinds()[name].title or name).lower()}: {'; '.join(told)}")
        return wrap_lines("\n".join(lines), indent=4)
    return "\n".join(lines)


def times_text(study: Study) -> str:
    """Roughly the time of the cases and of every task, "" where the method chooses its steps itself."""
    if study.method.step is None or study.duration is None:
        return ""
    bodies = sum(link.elements for link in study.mechanism.links)
    one = START_SECONDS + STEP_SECONDS * bodies * study.duration / study.method.step
    told = [f"cases {time_text(len(study.cases) * one)}"]
    if study.tasks.declared:
        from rfem_jax.report.tasks.catalogue import report_on

        for name in study.tasks.declared:
            work = report_on(study, name).work()
            title = (task_kinds()[name].title or name).lower()
            told.append(f"{title} {'not known beforehand' if work is None else time_text(work * one)}")
    text = f"Time of one core, roughly and without compilation (seconds to minutes): {', '.join(told)}."
    return wrap_lines(text)


def saved_times(study: Study) -> int:
    """Number of saved times of one case, the start and the jumps of the drive included."""
    duration = study.require_duration()
    save_every = duration / SAVED_BY_DEFAULT if study.save_every is None else study.save_every
    if study.method.step is not None:
        save_every = max(save_every, study.method.step)
    of_forces = [time for force in study.mechanism.point_forces for time in force.jumps()]
    jumps = {*study.drive_jumps, *of_forces}
    regular = math.ceil(duration / save_every * (1.0 - 1e-9))
    extra = [one for one in jumps if 0.0 < one < duration and abs(one / save_every - round(one / save_every)) > 1e-6]
    return 1 + regular + len(extra)


def numbers_saved(study: Study) -> int:
    """Numbers that a run holds for each saved time."""
    mechanism = study.mechanism
    joints, links = len(mechanism.joints), len(mechanism.links)
    angles = sum(len(joint.start_values) for joint in mechanism.tree_joints)
    # A pin with play moves in six ways, of which the angle about its axis is a result.
    coordinates = angles + sum(5 for joint in mechanism.tree_joints if joint.clearance is not None)
    elastic = 6 * sum(link.elements - 1 for link in mechanism.links)
    driven = max(len(study.drives), len(mechanism.driven_motions))
    # Time, angle, rate and moment of the drive, those of all drives, energies; loads and integrals of their squares;
    # coordinates of the tree; ends of the links; assembly modes.
    explicit = 4 + 3 * driven + 5 + 8 * joints + angles + 3 * links + len(mechanism.cut_joints)
    explicit += 12 * len(mechanism.point_forces)  # their forces, moments and points
    explicit += sum(isinstance(force, JointFriction) for force in mechanism.forces)  # lost energy
    explicit += 15 * sum(joint.clearance is not None for joint in mechanism.joints)  # of three contacts each
    explicit += coordinates + sum(KINDS[joint.kind].ball for joint in mechanism.tree_joints) + elastic  # positions
    if study.method.implicit or study.method.name == "auto":  # which may choose an implicit one
        closing = sum(6 - len(KINDS[joint.kind].freedoms) for joint in mechanism.cut_joints)
        closing += sum(one.ideal for one in mechanism.couplings)
        return explicit + coordinates + elastic + closing  # residuals
    return explicit


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
