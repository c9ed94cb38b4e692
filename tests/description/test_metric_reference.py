"""The reference of all metrics: nothing is left out, and what it says of joints is what a mechanism is told."""

import pytest

from rfem_jax import InputError
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.metrics.catalogue import (
    COUPLING_METRICS,
    JOINT_METRICS,
    LINK_METRICS,
    POINT_METRICS,
    RUN_METRICS,
)
from rfem_jax.description.metrics.reference import metric_tables
from rfem_jax.description.metrics.subjects import JointSubject, MetricSubjects, require_metric


def rows(number):
    return {row.name: row for row in metric_tables()[number].rows}


def test_every_metric_is_there_with_unit_and_meaning():
    for number, catalogue in enumerate((JOINT_METRICS, LINK_METRICS, POINT_METRICS, RUN_METRICS, COUPLING_METRICS)):
        assert list(rows(number)) == list(catalogue)
        for name, row in rows(number).items():
            assert row.unit == catalogue[name].unit and len(row.meaning) > 10
    peak, largest = rows(0)["peak_force"], rows(0)["max_force"]
    assert "lower bound of the maximum" in peak.meaning and peak.equation == "(8.7)"
    assert largest.unit == "N" and largest.equation == "(8.6)" and largest.needs == ""
    assert rows(0)["force_ratio"].needs == "only with `bearing.static_capacity`"
    assert rows(1)["max_stress"].needs == "only where the section's edge is known"
    assert rows(2)["max_deviation"].equation == "(8.21)" and rows(2)["max_deviation"].needs == ""
    assert rows(3)["peak_drive_power"].needs == "only where a joint is driven"
    assert rows(4)["max_mesh_force"].needs == "only where its second coordinate is a translation"
    assert rows(0)["end_displacement"].needs == "only of kinds prismatic, cylindrical, not cut"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["max_force", "max_axial_force", "end_angle", "displacement_range"])
def test_joints_that_have_a_metric_are_those_that_it_names(kind, name):
    subjects = MetricSubjects({"A": JointSubject(KINDS[kind], False)}, {})
    needs = rows(0)[name].needs
    if kind in needs.replace(",", "").split() or "kinds" not in needs:
        assert require_metric(f"*.{name}", subjects, "model") == (f"A.{name}",)
    else:
        with pytest.raises(InputError, match="must be of joints that have them"):
            require_metric(f"*.{name}", subjects, "model")


def test_a_joint_without_an_axis_is_told_of_the_resultant():
    subjects = MetricSubjects({"A": JointSubject(KINDS["spherical"], True)}, {})
    with pytest.raises(InputError, match="its kind has no axis .`max_force` is that of the resultant."):
        require_metric("A.max_normal_force", subjects, "model")
