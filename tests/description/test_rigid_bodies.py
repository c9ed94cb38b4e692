"""Links that are bodies: inertias of all forms, in Python and in a study file, and refusals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import Joint, Link, Mechanism, PointMass, Rectangle, RigidBody, assembly_errors, discretise, load_study
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.report.contents.overview import link_rows

from .test_several_drives import SLIDER

PRINCIPAL, ANGLES = (2e-3, 3e-3, 4e-3), (0.3, -0.5, 1.1)
TURN = Rotation.from_euler("xyz", ANGLES).as_matrix()
TENSOR = TURN @ np.diag(PRINCIPAL) @ TURN.T
OF_FILE = 'body = {mass = "300 g", centre = ["4 cm", 0, 0], inertia = ["2 kg mm^2", 3e-6, 4e-6]}'


def test_principal_moments_and_tensor_are_one():
    turned = RigidBody(0.5, (0.1, 0.0, 0.0), PRINCIPAL, ANGLES)
    np.testing.assert_allclose(turned.tensor, TENSOR, rtol=0, atol=1e-17)
    np.testing.assert_allclose(RigidBody(0.5, (0.1, 0.0, 0.0), TENSOR).tensor, TENSOR, rtol=0, atol=1e-17)


def test_mass_centre_and_inertia_of_the_model():
    """With a point mass besides, by the parallel-axis theorem."""
    body, point = RigidBody(0.5, (0.1, 0.02, -0.03), PRINCIPAL, ANGLES), PointMass(0.2, (0.3, 0.0, 0.1), (1e-4,) * 3)
    link = Link("a", 0.2, body=body, point_masses=[point])
    assert (link.mass, link.elements, link.flexible) == (pytest.approx(0.7), 1, False)
    model = discretise(Mechanism([link], [Joint("A", "base", "a")]))
    actual = apply_errors(model, assembly_errors(model))
    centre = (0.5 * np.array(body.centre) + 0.2 * np.array(point.position)) / 0.7
    expected = TENSOR + 1e-4 * np.eye(3)
    for mass, place in ((0.5, body.centre), (0.2, point.position)):
        arm = np.array(place) - centre
        expected += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    np.testing.assert_allclose(actual.mass, [0.7], rtol=1e-15)
    np.testing.assert_allclose(actual.centre[:, 0], centre, rtol=1e-14)
    np.testing.assert_allclose(actual.inertia[:, :, 0], expected, rtol=1e-12, atol=1e-17)
    assert jnp.all(jnp.linalg.eigvalsh(actual.inertia[:, :, 0]) > 0.0)


def test_without_products_there_is_nothing_more():
    made = discretise(Mechanism([Link("a", 0.2, body=RigidBody(0.5, (0, 0, 0), PRINCIPAL))], [Joint("A", "base", "a")]))
    assert made.point_products is None


def test_a_study_file(tmp_path):
    path = tmp_path / "study.toml"
    start = SLIDER.index('section = "bar"\nmaterial = "steel"\nrigid = true')
    text = SLIDER[:start] + OF_FILE + SLIDER[start + len('section = "bar"\nmaterial = "steel"\nrigid = true') :]
    path.write_text(text, encoding="utf-8")
    study = load_study(path)
    assert study.mechanism.link("arm").body == RigidBody(0.3, (0.04, 0.0, 0.0), (2e-6, 3e-6, 4e-6))
    assert link_rows(study.mechanism)[0] == ["arm", "0.1", "0.3", "rigid", "-", "rigid body"]


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: RigidBody(0.0, (0, 0, 0), PRINCIPAL), ("`mass` of a body", "greater than 0")),
        (lambda: RigidBody("1 m", (0, 0, 0), PRINCIPAL), ("`mass` of a body", "a length")),
        (lambda: RigidBody(1.0, (0, 0), PRINCIPAL), ("`centre` of a body", "three components")),
        (lambda: RigidBody(1.0, (0, 0, 0), (1.0, 1.0)), ("`inertia` of a body", "three rows")),
        (lambda: RigidBody(1.0, (0, 0, 0), (1.0, 1.0, 2.5)), ("`inertia` of a body", "sum of the two others")),
        (lambda: RigidBody(1.0, (0, 0, 0), (1.0, 1.0, 0.0)), ("`inertia` of a body", "positive definite")),
        (lambda: RigidBody(1.0, (0, 0, 0), [[1, 2, 0], [2, 1, 0], [0, 0, 1]]), ("positive definite", "-1.0")),
        (lambda: RigidBody(1.0, (0, 0, 0), [[1, 0.1, 0], [0.2, 1, 0], [0, 0, 1]]), ("symmetric",)),
        (lambda: RigidBody(1.0, (0, 0, 0), [[1, 0], [0, 1], [0, 0]]), ("`inertia` of a body (row 1)",)),
        (lambda: Link("a", 0.1, body=3.0), ("`body` of link `a`", "a RigidBody")),
        (lambda: Link("a", 0.1, Rectangle(0.01, 0.01), body=BODY), ("`section` of link `a`", "has a body")),
        (lambda: Link("a", 0.1, body=BODY, rfes=7), ("`rfes` of link `a`", "which is not divided")),
        (lambda: Link("a", 0.1), ("`section` of link `a`", "or a `body`")),
    ],
)
def test_bodies_that_there_are_not_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()


BODY = RigidBody(1.0, (0.0, 0.0, 0.0), PRINCIPAL)
