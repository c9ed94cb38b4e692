"""Forces at points and between them: the overview of `check`, columns of histories, the picture."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rfem_jax import DistributedForce, PointForce, PointMoment, PointSpring, PointSpringTable, discretise
from rfem_jax.report.contents.files import history_columns
from rfem_jax.report.contents.overview import _forces_text
from rfem_jax.report.drawings.force_shapes import arrow, zigzag
from rfem_jax.report.drawings.shapes import assembly_figure
from rfem_jax.report.page.acting import acting_arrays, describe_acting
from rfem_jax.report.tasks.study_cost import saved_times
from rfem_jax.simulation.outcome.run import PointHistory
from tests.mechanisms import four_bar

FORCES = (
    PointSpring("coil", ["base", "coupler"], [(0.1, 0, 0), 0.15], 200.0, free_length="8 cm"),
    PointForce("push", "rocker", (0.1, 0, 0.01), [(0, 0, 0), (0, 0, 5), (0, 0, 5)], [0, 0.123, 0.25], axes="link"),
    PointMoment("twist", "crank", 0.0, (0, 2, 0)),
    DistributedForce("wind", "coupler", (0, 0, 10), (0, 0, 30), begin=0.1),
)  # fmt: skip


@pytest.fixture
def loaded(study):
    mechanism = replace(study.mechanism, forces=FORCES)
    return replace(study, mechanism=mechanism, cases=study.cases[:1])


@pytest.fixture
def run(runs):
    """A spring that is stretched from 0.3 m to 0.4 m along z by 20 N; a force that begins at zero."""
    run, still = runs["P2"], np.zeros((11, 3))
    z = np.linspace(0.3, 0.4, 11)[:, None] * [0.0, 0.0, 1.0]
    one = np.ones((11, 1))
    run.forces = {
        "coil": PointHistory(-20.0 * one * [0, 0, 1.0], still, one * [0.1, 0, 0] + z, one * [0.1, 0, 0]),
        "push": PointHistory(np.linspace(0, 5, 11)[:, None] * [1.0, 0, 0], still, one * [0.2, 0, 0.1], still),
        "twist": PointHistory(still, one * [0, 2.0, 0], still, still),
        "wind": PointHistory(one * [0, 0, 4.0], still, one * [0.3, 0, 0.2], still),
    }
    return run


def test_overview(loaded):
    coil, push, twist, wind = _forces_text(loaded.mechanism).splitlines()
    assert coil.startswith("Force coil: point spring between base (0.1, 0, 0) m and coupler (0.15, 0, 0) m")
    assert "stiffness 200, damping 0, free length 0.08" in coil
    assert push == "Force push: point force at rocker (0.1, 0, 0.01) m, over time in link axes."
    assert twist == "Force twist: point moment at crank (0, 0, 0) m, (0, 2, 0) N m in global axes."
    assert wind == (
        "Force wind: distributed force along coupler, (0, 0, 10) N/m to (0, 0, 30) N/m in global axes (SI: begin 0.1)."
    )
    table = PointSpringTable("t", ["base", "crank"], [(1, 0, 0), 0.1], [0, 1], [2, 3])
    assert "point spring table between base" in _forces_text(replace(loaded.mechanism, forces=[table]))


def test_columns(loaded, run):
    columns = history_columns(loaded, run)
    names = list(columns)[-11:]
    assert names == ["coil_length_m", "coil_tension_N", *(f"push_force_{x}_N" for x in "xyz"),
                     *(f"twist_moment_{x}_Nm" for x in "xyz"), *(f"wind_force_{x}_N" for x in "xyz")]  # fmt: skip
    np.testing.assert_allclose(columns["coil_length_m"], np.linspace(0.3, 0.4, 11))
    np.testing.assert_allclose(columns["coil_tension_N"], 20.0)
    np.testing.assert_allclose(columns["push_force_x_N"], np.linspace(0.0, 5.0, 11))
    np.testing.assert_allclose(columns["twist_moment_y_Nm"], 2.0)
    np.testing.assert_allclose(columns["wind_force_z_N"], 4.0)


def test_jumps_are_saved_times(loaded, study):
    # The drive's jump, and the end of the first table, fall on times every 0.05 s.
    table = replace(FORCES[1], times=[0, 0.123, 0.126])
    moved = replace(loaded, mechanism=replace(loaded.mechanism, forces=[table]))
    assert saved_times(loaded) == saved_times(study)
    assert saved_times(moved) == saved_times(study) + 1


def test_the_picture_shows_them(loaded, run):
    figure = assembly_figure(loaded, {"P1": run})
    (axes,) = figure.axes
    texts = [text.get_text().strip() for text in axes.texts]
    assert {"coil", "push", "twist", "wind"} <= {*texts}
    # From the base's point to the coupler, whose deflection is exaggerated: away from where the run has it.
    spring = next(line for line in axes.lines if len(line.get_data_3d()[0]) == 20)
    points = np.array(spring.get_data_3d()).T
    np.testing.assert_allclose(points[0], [0.1, 0.0, 0.0])
    assert points[-1][1] > 2.0 * 0.5 * 2e-3
    np.testing.assert_allclose(points[-1][[0, 2]], [0.1, 0.3], atol=1e-12)


def test_arrows_and_zigzags():
    rising = np.array([[0.0, 0, 0], [0, 0, 1.0], [0, 0, -4.0]])
    np.testing.assert_allclose(arrow(rising, 0.1), [0.0, 0.0, -0.1])
    np.testing.assert_allclose(arrow(0.0 * rising, 0.1), 0.0)
    for end in ([0.3, 0.1, 0.0], [0.0, 0.5, 0.0]):
        points = zigzag(np.zeros(3), np.array(end), 0.01)
        across = np.linalg.norm(points - np.outer(points @ end, end) / (np.array(end) @ end), axis=1)
        np.testing.assert_allclose([across[0], across[-1]], 0.0, atol=1e-15)
        np.testing.assert_allclose(across[2:-2], 0.01)


def test_the_page_is_told_of_them():
    """A load along a link is drawn as all of its force, on the link that it acts on."""
    model = discretise(four_bar(2, forces=FORCES))
    histories = {name: PointHistory(*np.full((4, 11, 3), n)) for n, name in enumerate(("coil", "twist", "wind"))}
    run = SimpleNamespace(model=model, forces=histories)
    told = describe_acting(run)["forces"]
    assert told == [
        {"name": "coil", "kind": "spring", "links": ["base", "coupler"]},
        {"name": "twist", "kind": "moment", "links": ["crank"]},
        {"name": "wind", "kind": "force", "links": ["coupler"]},
    ]
    np.testing.assert_allclose(acting_arrays(run, told, np.arange(2))["force_value"][:, 2], 2.0)
