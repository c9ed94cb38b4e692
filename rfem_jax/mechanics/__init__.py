"""One instant: discretisation, errors, kinematics, dynamics, closure, joint loads; static assembly.

model, discretisation      description -> Model
nominal_geometry           the perfect mechanism in NumPy: does it close, rank, mobility
realisation                + AssemblyErrors -> constants of the equations of motion
kinematics                 + State -> positions and velocities
elasticity, exact_elements forces of the sdes, linear and geometrically exact
cut_joints                 constraints of the cut joints
inputs                     what the drive does at the instant
dynamics                   accelerations by the recursive formulation
reference_formulation      the same, dense and literal, to test against
loads                      joint loads, energies, balances
balance                    what given accelerations and multipliers leave over
chains, condensation       a flexible link as implicit steps feel it
newton                     what takes away the rest, by the links' structure
statics                    assembled start state and preload
static_matrix, _search     its equations solved, by the links' structure and by Newton's method
"""

from rfem_jax.mechanics.discretisation import Structure, describe, discretise
from rfem_jax.mechanics.model import Coordinates, Model, State
from rfem_jax.mechanics.model_with_errors import AssemblyErrors, assembly_errors
from rfem_jax.mechanics.statics import Assembled, Load, assemble
from rfem_jax.mechanics.status import STATUS

__all__ = [
    "STATUS",
    "Assembled",
    "AssemblyErrors",
    "Coordinates",
    "Load",
    "Model",
    "State",
    "Structure",
    "assemble",
    "assembly_errors",
    "describe",
    "discretise",
]
