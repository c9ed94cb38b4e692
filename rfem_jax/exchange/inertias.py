"""Masses and inertias as a study may have them.

Place in the pipeline: called by `laying`. Files of other programs have bodies without mass, points, thin rods without
a moment about their axis, and moments rounded so that they are those of no body.
"""

from dataclasses import replace

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.layout import Body, Layout

_SMALLEST = 1e-6  # of a principal moment over the largest one
_OF_A_POINT = 1e-3  # radius of gyration of a point mass over the size of the mechanism
_ROUNDED = 1e-2  # by which the largest moment may exceed the sum of the two others
_EXACT = 1e-10


def sound(layout: Layout, size: float) -> Layout:
    """The same with inertias of real bodies, and a remark on each that had to be changed. Raises InputError."""
    bodies, remarks = [], []
    for body in layout.bodies:
        changed, why = _sound(body, size)
        bodies.append(changed)
        if why:
            remarks.append(f"Link {body.name}: {why}.")
    return replace(layout, bodies=tuple(bodies)).remarked(*remarks)


def _sound(body: Body, size: float) -> tuple[Body, str]:
    tensor = 0.5 * (body.inertia + body.inertia.T)
    if not (np.isfinite(body.mass) and np.isfinite(tensor).all() and np.isfinite(body.centre).all()):
        raise InputError(
            f"Link `{body.name}` must have finite numbers as its mass and inertia, but has not; correct it."
        )
    if body.mass < 0.0:
        raise InputError(f"The mass of link `{body.name}` must be at least 0, but is {body.mass:g} kg; correct it.")
    if body.mass == 0.0:
        bare = replace(body, inertia=np.zeros((3, 3)))
        return bare, "it has no mass, so that only positions at rest can be computed (`rfem-jax turn`)"
    moments, axes = np.linalg.eigh(tensor)
    largest = float(moments[-1])
    if largest <= 0.0:
        if np.any(moments < 0.0):
            raise _refused(body, moments)
        moment = body.mass * (_OF_A_POINT * size) ** 2
        return replace(body, inertia=moment * np.eye(3)), f"a point mass, which got the moments {moment:.3g} kg m^2"
    if moments[0] < -_EXACT * largest:
        raise _refused(body, moments)
    why = ""
    if moments[0] < _EXACT * largest:
        moments = np.maximum(moments, _SMALLEST * largest)
        why = f"a principal moment of zero became {_SMALLEST * largest:.3g} kg m^2"
    excess = moments[-1] - moments[:2].sum()
    if excess > _EXACT * largest:
        if excess > _ROUNDED * largest:
            raise _refused(body, moments)
        moments[0] += excess
        why = "its smallest moment was raised to that of a body whose largest one is no more than the other two"
    return replace(body, inertia=(axes * moments) @ axes.T if why else tensor), why


def _refused(body: Body, moments: np.ndarray) -> InputError:
    listed = ", ".join(f"{one:.4g}" for one in moments)
    return InputError(
        f"The inertia of link `{body.name}` must be that of a real body (positive, none larger than the sum of the two "
        f"others), but has the principal moments {listed} kg m^2; correct it in the file."
    )
