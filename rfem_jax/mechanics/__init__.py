"""One instant: discretisation, errors, kinematics, dynamics, closure, joint loads; static assembly.

A room for each step, from the bottom; imports go one way (`tests/test_structure.py`).

algebra      vectors, rotations, products; derivative rules
laws         springs, contacts, friction, forces, as functions of their own motion
model        description -> Model; + AssemblyErrors -> constants of the equations of motion
kinematics   + State -> positions and velocities; constraints of the cut joints
elements     forces of the sdes, linear and geometrically exact
forces       what acts at one instant: along joints, between points, in contacts, by friction
dynamics     accelerations by the articulated-body algorithm; joint loads, energies
reference    the same, dense, to test against
implicit     residual of the equations for given accelerations, its Newton increments
statics      assembled start state and preload; other numbers of a model (designs)
"""

from rfem_jax.mechanics.model.discretisation import Structure, describe
from rfem_jax.mechanics.model.errors import AssemblyErrors, Deviations, assembly_errors, deviations
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.mechanics.statics.assembly import Assembled, Load, assemble
from rfem_jax.mechanics.statics.designs import Design, design, designed, parameters
from rfem_jax.mechanics.statics.traced_descriptions import discretise

__all__ = [
    "STATUS",
    "Assembled",
    "AssemblyErrors",
    "Coordinates",
    "Design",
    "Deviations",
    "Load",
    "Model",
    "State",
    "Structure",
    "assemble",
    "assembly_errors",
    "describe",
    "design",
    "designed",
    "deviations",
    "discretise",
    "parameters",
]
