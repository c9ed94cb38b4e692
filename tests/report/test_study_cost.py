"""What `check` says about the cost of a study: numbers that the run then has."""

from dataclasses import replace

import jax
import pytest

from rfem_jax import (
    Clearance,
    Explicit,
    GeneralisedAlpha,
    JointFriction,
    MomentRamp,
    RungeKutta4,
    Simulation,
    Study,
    assembly_errors,
    discretise,
    load_study,
    simulate,
)
from rfem_jax.description.tasks import Tasks
from rfem_jax.report.tasks.study_cost import STEP_SECONDS, cost_text, numbers_saved, saved_times, times_text
from rfem_jax.text_layout import size_text, time_text
from rfem_jax.validation.clearances import flexible_four_bar

from .conftest import STUDY
from .test_tasks import PENDULUM, TASKS


@pytest.fixture
def tasks(tmp_path):
    """{name: what is told} of a study with every task."""

    def told(text):
        path = tmp_path / "study.toml"
        path.write_text(STUDY + text, encoding="utf-8")
        text = cost_text(load_study(path)).replace("\n    ", " ")
        return dict(line.strip().split(": ", 1) for line in text.splitlines()[1:])

    return told


@pytest.mark.parametrize(
    ("method", "save_every"),
    [
        (RungeKutta4(step=1e-3), 2e-3),
        (RungeKutta4(step=3e-4), None),
        (GeneralisedAlpha(step=2e-3), 3e-3),
    ],
)
def test_the_size_of_results_is_that_of_a_run(tmp_path, method, save_every):
    path = tmp_path / "study.toml"
    path.write_text(PENDULUM.split("[tolerances]")[0], encoding="utf-8")
    drive = MomentRamp("A", 1.0, 5e-3)  # jumps between two saved times
    study = replace(load_study(path), duration=0.02, save_every=save_every, method=method, drive=drive)
    model = discretise(study.mechanism)
    simulation = Simulation.of(study, model=model)
    run = jax.eval_shape(lambda: simulate(simulation, assembly_errors(model, {})))
    (times,) = run.times.shape
    assert saved_times(study) == times
    histories = [leaf for leaf in jax.tree.leaves(run) if leaf.shape[:1] == (times,)]
    assert numbers_saved(study) == sum(leaf.size for leaf in histories) / times


@pytest.mark.parametrize("cut", [False, True])
def test_the_size_of_results_with_clearance_and_friction(cut):
    loose = flexible_four_bar(cut=cut)
    mechanism = replace(loose, forces=(JointFriction("rubbing", "B", constant=0.1, sliding_rate=0.1),))
    study = Study("Play", mechanism, None, 0.016, GeneralisedAlpha(step=1e-3), 1e-3, ())
    model = discretise(mechanism)
    run = jax.eval_shape(
        lambda: simulate(
            Simulation(model, drive=None, duration=study.duration, method=study.method, save_every=study.save_every)
        )
    )
    (times,) = run.times.shape
    histories = [leaf for leaf in jax.tree.leaves(run) if leaf.shape[:1] == (times,)]
    assert numbers_saved(study) == sum(leaf.size for leaf in histories) / times


def test_every_task_tells_its_simulations(tasks):
    told = tasks(TASKS)
    assert told["cases"].startswith("3 simulations of 50000 steps, computed together; results at 11 saved times")
    assert told["sensitivity"].startswith("1 simulation with first and second derivatives by 3 errors, and another")
    assert told["monte carlo"].startswith("32 simulations in chunks of 8")
    assert told["worst case"].startswith("13 simulations with first derivatives by 3 errors")
    assert "for each metric (2) one at the centre, at 4 starts and 8 corners, and at most 4 x 100" in told["worst case"]
    assert "for each of 3 allocations worst-case searches" in told["allocation"]


def test_settings_change_the_numbers(tasks):
    told = tasks(
        TASKS.replace("seed = 3", "sobol_indices = true\ncontrol_variate = true")
        .replace("starts = { corners = 2, sobol = 2 }\n[alloc", 'region = "ellipsoid"\n[alloc')
        .replace("starts = { corners = 2, sobol = 2 }\nscales = [0.5, 2.0]", 'criterion = "rss"\nsamples = 256')
        .replace("half_step = true", "order = 1")
    )
    assert told["sensitivity"] == "1 simulation with first derivatives by 3 errors"
    assert told["monte carlo"].startswith("160 simulations in chunks of 8; 13 with first derivatives")
    assert "at 16 starts, and at most 16 x 100" in told["worst case"]
    assert told["allocation"].endswith("256 with derivatives in every round, 4096 in every verification")


def test_derivatives_are_taken_twice_where_pins_may_strike(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + TASKS.replace("half_step = true", ""), encoding="utf-8")
    study = load_study(path)
    assert "another with the finer step" not in cost_text(study)
    play = Clearance(radial=1e-4, length=0.02, stiffness=5e7, exponent=1)
    joints = [replace(joint, clearance=play if joint.name == "D" else None) for joint in study.mechanism.joints]
    striking = replace(study, mechanism=replace(study.mechanism, joints=joints))
    assert "another with the finer step" in " ".join(cost_text(striking).split())
    at_rest = replace(study.tasks.sensitivity, metrics=("D.preload_force_square",))
    striking = replace(striking, tasks=Tasks(study.tasks.tolerances, sensitivity=at_rest))
    assert "another with the finer step" not in " ".join(cost_text(striking).split())


def test_times_go_by_steps_bodies_and_simulations(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + TASKS.replace("n = 32", "n = 32000"), encoding="utf-8")
    study = replace(load_study(path), method=RungeKutta4(step=5e-6))

    def told(study):
        return " ".join(times_text(study).split())

    one = 100_000 * 11 * STEP_SECONDS  # steps; a rigid crank and two links of five rfes
    assert f"cases {3 * one:.0f} s, sensitivity 20 s, monte carlo {32000 * one / 3600:.0f} hours" in told(study)
    assert told(study).endswith("allocation not known beforehand.")
    assert f"cases {6 * one:.0f} s," in told(replace(study, method=RungeKutta4(step=2.5e-6)))
    assert times_text(replace(study, method=Explicit("tsit5", rtol=1e-8, atol=1e-10))) == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.3, "less than a second"),
        (1.04, "1 s"),
        (34.0, "30 s"),
        (61.0, "1 minute"),
        (7300.0, "2 hours"),
        (3e5, "3 days"),
    ],
)
def test_times_and_sizes_have_the_unit_that_suits_them(seconds, text):
    assert time_text(seconds) == text
    assert (size_text(2.44e9), size_text(2.44e6)) == ("2.4 GB", "2.4 MB")
