"""Arrays have the shapes and kinds that annotations say: a simulation is traced with all of them checked."""

import pytest

from tests.processes import in_a_new_process

CHECKED = """
import jaxtyping
jaxtyping.install_import_hook(
    ["rfem_jax.description", "rfem_jax.mechanics", "rfem_jax.simulation"], "beartype.beartype"
)
import jax
jax.config.update("jax_enable_x64", True)
import rfem_jax
from tests.mechanisms import chain_with_balls, four_bar, loop_with_a_ball, two_cuts_of_different_kinds

drive = rfem_jax.MomentRamp("A", 1.5, 0.01)
for elements in ("linear", "geometrically_exact"):
    model = rfem_jax.discretise(four_bar(3), elements=elements)
    for method in (rfem_jax.RungeKutta4(step=1e-5), rfem_jax.GeneralisedAlpha(step=1e-3)):

        def simulate(tilt):
            errors = rfem_jax.assembly_errors(model, {"D.delta_x": tilt})
            settings = {"duration": 0.02, "method": method, "save_every": 1e-2}
            run = rfem_jax.simulate(rfem_jax.Simulation(model, drive=drive, **settings), errors)
            return run.metrics.mean_square_moment["D"]

        # A derivative by each method and of each kind of elements.
        differentiated = (elements == "linear") == (method.name == "rk4")
        print(jax.eval_shape(jax.jacfwd(simulate) if differentiated else simulate, 0.01).shape)
for make, method in (
    (chain_with_balls, rfem_jax.RungeKutta4(step=1e-5)),
    (loop_with_a_ball, rfem_jax.GeneralisedAlpha(step=1e-3)),
    (two_cuts_of_different_kinds, rfem_jax.Leapfrog(step=1e-5)),
):
    model = rfem_jax.discretise(make())
    driven = drive if model.driven_joint else None

    def largest(length):
        errors = rfem_jax.assembly_errors(model, {f"{model.link_names[0]}.length": length})
        settings = {"duration": 0.02, "method": method, "save_every": 1e-2}
        run = rfem_jax.simulate(rfem_jax.Simulation(model, drive=driven, **settings), errors)
        return run.metrics.mean_square_force[model.joint_names[-1]]

    print(jax.eval_shape(largest, 1e-5).shape)
try:
    from rfem_jax.mechanics.algebra import vectors
    vectors.rotation_y("no array")
except jaxtyping.TypeCheckError:
    print("checked")
"""


@pytest.mark.slow
def test_a_simulation_has_the_shapes_of_its_annotations():
    """Tracing alone: nothing is compiled."""
    assert in_a_new_process(CHECKED).splitlines() == ["()"] * 7 + ["checked"]
