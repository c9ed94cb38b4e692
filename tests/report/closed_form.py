"""A closed-form stand-in for the simulator: quadratic loads of the four-bar's errors at joint D.

Place in the tests: replaces `rfem_jax.report.tasks.study_problem.build_problem`; also imported by the
processes that the tests start.
"""

import math

import jax.numpy as jnp

from rfem_jax import FunctionProblem, Metric

NAMES = ("D.delta_x", "D.delta_z", "D.d_y")
WIDTHS = (math.radians(0.25), math.radians(0.25), 2.5e-4)
# Moments per tolerance of each error: M^2 = sum (a_i z_i)^2, worst in every corner the same.
ROOTS = (4.0, 2.0, 1.0)
METRICS = {
    "D.mean_square_moment": Metric("D.mean_square_moment", "(N m)^2", "mean square moment in D"),
    "A.mean_square_force": Metric("A.mean_square_force", "N^2", "mean square force in A"),
}


def loads(errors, factor):
    z = jnp.stack([errors[name] for name in NAMES]) / jnp.asarray(WIDTHS)
    moment = jnp.sum((jnp.asarray(ROOTS) * z) ** 2)
    return {
        "D.mean_square_moment": factor * moment,
        "A.mean_square_force": 900.0 + 30.0 * z[0] + 5.0 * z[1] ** 2,
    }


class ClosedForm(FunctionProblem):
    """The problem of the stand-in; `refined` changes all moments by one per cent."""

    undamped = False

    def refined(self):
        return build(METRICS if len(self.metrics) == 2 else [self.metrics[0].name], 1.01)


def build(metrics, factor=1.0):
    def function(errors):
        values = loads(errors, factor)
        return {name: values[name] for name in metrics}

    units = {"D.d_y": "m"}
    return ClosedForm(function, NAMES, [METRICS[name] for name in metrics], error_units=units)


def build_problem(study, metrics, model=None, trials=None):
    """In place of `rfem_jax.report.tasks.study_problem.build_problem`."""
    return build(metrics)
