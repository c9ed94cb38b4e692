"""Where a run is at its saved times, and the page that it writes of itself."""

import dataclasses

import jax
import numpy as np
import pytest

from rfem_jax import InputError, assembly_errors, report_run
from rfem_jax.mechanics.dynamics.centre_lines import trace_shapes
from tests.report.page_folder import content_of

ERRORS = {"D.delta_x": 0.004, "D.d_y": 2e-4}


@pytest.fixture(scope="module")
def run(small):
    return jax.tree.map(np.asarray, small.run(ERRORS))


@pytest.fixture(scope="module")
def shapes(small, run):
    return jax.tree.map(
        np.asarray, trace_shapes(small.model, assembly_errors(small.model, ERRORS), run.motion.positions)
    )


def test_a_run_knows_what_was_simulated(small, run):
    wanted = assembly_errors(small.model, ERRORS)
    for kept, given in ((run.errors, wanted), (run.model, dataclasses.replace(small.model, source=None))):
        for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(given), strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(run.motion.positions.joints[:, 0], run.motion.angle)


def test_former_names_of_what_is_in_groups_work_and_warn(run):
    """`run.angle` is `run.motion.angle` now, and so on: the former names go with the next version."""
    former = {
        "motion": (
            "angle rate drive_moment drives angles displacements ends branch centre_lines nominal_lines positions"
        ),
        "checks": (
            "energy_balance_error closure_drift closure_drift_angle momentum_balance_error hinge_moment_error "
            "stabilisation_share solution_residual linear_error equation_residual design_gap"
        ),
    }
    for group, names in former.items():
        for name in names.split():
            with pytest.warns(DeprecationWarning, match=f"run.{group}.{name}"):
                assert getattr(run, name) is getattr(getattr(run, group), name)
    with pytest.warns(DeprecationWarning, match=r"run\.motion"):
        assert run.driven_joint.angle_end == run.motion.angle[-1] and run.motion.rate_end == run.motion.rate[-1]
    with pytest.raises(AttributeError, match="no 'anlge'; it has times, loads"):
        _ = run.anlge


def test_lines_are_those_of_the_run_and_end_where_links_end(small, run, shapes):
    lines = np.split(shapes.points, np.cumsum([2, 4]), axis=1)
    for name, line in zip(small.model.link_names, lines, strict=True):
        np.testing.assert_allclose(line[0], run.motion.centre_lines[name], rtol=0, atol=1e-12)
        np.testing.assert_allclose(line[:, -1], run.motion.ends[name], rtol=0, atol=1e-12)


def test_joints_stand_where_their_links_meet(small, run, shapes):
    at = {name: j for j, name in enumerate(small.model.topology.joints)}
    np.testing.assert_allclose(shapes.centre[:, at["A"]], 0.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(shapes.centre[:, at["D"]], np.tile([0.3, 2e-4, 0.0], (21, 1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(shapes.centre[:, at["B"]], run.motion.ends["crank"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(shapes.centre[:, at["C"]], run.motion.ends["rocker"], rtol=0, atol=1e-12)
    tilt = np.array([0.0, np.cos(0.004), np.sin(0.004)])  # the axis y, tilted about x
    np.testing.assert_allclose(shapes.rotation[:, at["D"], :, 1], np.tile(tilt, (21, 1)), rtol=0, atol=1e-12)


def test_arrows_of_loads_stand_in_equilibrium_with_the_weight(small, run, shapes):
    """At the start, with the frames of the page: forces of the base carry the weight, and moments and forces about A
    hold its moment, for which every link's weight acts at the middle of its line."""
    loads = [run.preload[name] for name in small.model.topology.joints]
    force, moment = (
        {name: shapes.rotation[0, j] @ part for j, (name, part) in enumerate(zip(small.model.topology.joints, parts))}
        for parts in ([one.force for one in loads], [one.moment for one in loads])
    )
    masses = {"crank": 0.12, "coupler": 0.3, "rocker": 0.3}
    weights = {name: 9.81 * 7850.0 * 1e-4 * length for name, length in masses.items()}
    total = sum(weights.values())
    np.testing.assert_allclose(force["A"] + force["D"], [0.0, 0.0, total], rtol=0, atol=1e-6 * total)
    centre = dict(zip(small.model.topology.joints, shapes.centre[0], strict=True))
    turning = moment["A"] + moment["D"] + np.cross(centre["D"] - centre["A"], force["D"])
    lines = dict(zip(small.model.link_names, np.split(shapes.points[0], np.cumsum([2, 4])), strict=True))
    for name, weight in weights.items():
        middle = 0.5 * (lines[name][0] + lines[name][-1]) - centre["A"]
        turning += np.cross(middle, [0.0, 0.0, -weight])
    size = np.abs(moment["D"]).max()
    assert size > 1.0
    np.testing.assert_allclose(turning[[0, 2]], 0.0, atol=1e-4 * size)  # about y the held joint A takes the rest


def test_the_page_of_a_run(run, tmp_path):
    path = report_run(run, tmp_path)
    assert path == tmp_path / "report.html"
    content = content_of(path)
    (case,) = content["cases"]
    assert case["status"] == "ok"
    assert case["errors"] == [["D.delta_x", 0.004, "rad"], ["D.d_y", 2e-4, "m"]]
    joints = {row["name"]: row for row in case["joints"]}
    assert {name: row["rms_moment"] for name, row in joints.items()} == {
        name: float(value) for name, value in run.metrics.rms_moment.items()
    }
    assert [one["name"] for one in content["animation"]["links"]] == list(run.model.link_names)
    labels = [one["label"] for one in content["histories"]["quantities"]]
    assert {"Force in A", "Moment in D", "A angle", "Rate", "Kinetic energy"} <= set(labels)
    with pytest.warns(DeprecationWarning, match="report_run") as caught:
        assert run.report(tmp_path / "mine.html") == tmp_path / "mine.html"
    assert caught[0].filename == __file__
    assert (tmp_path / "mine.html").exists()


def test_a_batch_has_no_page(run, tmp_path):
    batch = jax.tree.map(lambda x: np.stack([x, x]), run)
    with pytest.raises(InputError, match="take one"):
        report_run(batch, tmp_path)
    with pytest.raises(InputError, match="must be a Run, but is dict"):
        report_run({}, tmp_path)
