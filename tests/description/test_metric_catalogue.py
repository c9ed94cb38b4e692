"""Metrics registered from outside the package: known in study files, refused where they cannot be meant."""

from pathlib import Path

import pytest

from rfem_jax import load_study, register_metric
from rfem_jax.description.metrics.catalogue import JOINT_METRICS, RUN_METRICS

FOUR_BAR = (Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def restored():
    """The catalogue is the same afterwards."""
    kept = [(catalogue, dict(catalogue)) for catalogue in (JOINT_METRICS, RUN_METRICS)]
    yield
    for catalogue, entries in kept:
        catalogue.clear()
        catalogue.update(entries)


def load(tmp_path, metrics, limits=""):
    path = tmp_path / "study.toml"
    tables = f'\n[tolerances]\n"D.delta_x" = "0.2 deg"\n[monte_carlo]\nn = 16\nmetrics = {metrics}\n{limits}'
    path.write_text(FOUR_BAR + tables, encoding="utf-8")
    return load_study(path).tasks.monte_carlo


def test_study_files_know_a_registered_metric_from_then_on(tmp_path, refused):
    with refused("'swing' is not a metric"):
        load(tmp_path, '["swing"]')
    register_metric("swing", "rad", lambda run: run.motion.angle.max())
    register_metric("end_force", "N", lambda run, joint: run.loads[joint].force[-1, 0], of_joints=True)
    task = load(tmp_path, '["*.end_force", "swing"]', 'limits = { "A.end_force" = -1.0 }')
    assert task.metrics == ("A.end_force", "B.end_force", "D.end_force", "C.end_force", "swing")
    assert task.limits["A.end_force"] == (float("-inf"), -1.0)
    with refused("did you mean `A.end_force`?"):
        load(tmp_path, '["A.end_forse"]')
    with refused("did you mean `swing`?"):
        load(tmp_path, '["swin"]')
    with refused("`E`"):
        load(tmp_path, '["E.end_force"]')


def test_the_motion_of_a_joint_is_a_metric_where_it_has_one(tmp_path, refused):
    task = load(tmp_path, '["*.end_angle"]', 'limits = { "D.angle_range" = "30 deg", "D.end_angle" = ["-1 deg", 0.5] }')
    assert task.metrics == ("A.end_angle", "B.end_angle", "D.end_angle", "D.angle_range")
    assert task.limits["D.angle_range"][1] == pytest.approx(0.5235987756)
    assert task.limits["D.end_angle"] == (pytest.approx(-0.01745329252), 0.5)
    with refused("`C.end_angle`", "A, B, D"):
        load(tmp_path, '["C.end_angle"]')
    with refused("`*.end_displacement`", "no joint has it"):
        load(tmp_path, '["*.end_displacement"]')
    with refused("`limits`", "angle_range", "mm"):
        load(tmp_path, '["D.end_angle"]', 'limits = { "D.angle_range" = "3 mm" }')


def test_limits_of_a_metric_that_is_never_negative_are_positive(tmp_path, refused):
    register_metric("height", "m", lambda run: run.motion.angle[-1] ** 2, nonnegative=True)
    assert load(tmp_path, '["height"]', "limits = { height = 1.0 }").limits == {"height": (float("-inf"), 1.0)}
    with refused("never negative", "`height`"):
        load(tmp_path, '["height"]', "limits = { height = -1.0 }")


def test_a_metric_is_of_one_kind_of_things(refused):
    for owners in (("joints", "links"), ("joints", "points"), ("links", "points")):
        first, second = owners
        with refused(f"`of_{second}` of the metric `swing` must be left out for a metric of {first}"):
            register_metric("swing", "rad", abs, **{f"of_{one}": True for one in owners})


@pytest.mark.parametrize(
    ("arguments", "pieces"),
    [
        (("A.swing", "rad", abs), ("`name`", "'A.swing'")),
        (("rms_force", "N", abs), ("`rms_force` is registered already", "replace=True")),
        pytest.param(("swing", "rad", 3.0), ("`function` of the metric `swing`", "3.0"), marks=pytest.mark.wrong_types),
    ],
)
def test_metrics_that_cannot_be_meant_are_refused(arguments, pieces, refused):
    with refused(*pieces):
        register_metric(*arguments)


def test_a_metric_is_replaced_on_request_only():
    register_metric("swing", "rad", abs)
    register_metric("swing", "N", lambda run, joint: 0.0, of_joints=True, replace=True)
    assert "swing" not in RUN_METRICS and JOINT_METRICS["swing"].unit == "N"
    assert JOINT_METRICS["swing"].label == "swing in {joint}"
