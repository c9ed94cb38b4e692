"""One instant: discretisation, errors, kinematics, dynamics, closure, joint loads; static assembly.

model, model_building       description -> Model
discretisation              its loops closed at the start, rank and mobility
nominal_geometry            the perfect mechanism in NumPy: does it close, rank, mobility
model_with_errors           + AssemblyErrors -> constants of the equations of motion
kinematics                  + State -> positions and velocities
sources, designs            the numbers that a model was made of, and other ones; start_closure: its loops closed anew
centre_lines                where the links are in space
elements                    forces of the sdes, linear and geometrically exact
cut_joints                  constraints of the cut joints; self_stress: what they leave open, the least reactions
joint_laws                  springs, dampers, tables and functions along joint coordinates
friction_laws, friction     friction in joints; whether its normal_loads are unique
frame_forces, point_laws    wrenches between two frames, springs and forces at points
element_loads               what all of these exert at one instant
inputs, joint_forces        the drive at one instant, forces along the joint coordinates
dynamics                    accelerations by the articulated-body algorithm
reference_formulation       the same, dense, to test against; with reference_loads, reference_friction
loads                       joint loads, energies, balance of momentum
implicit                    residual of the equations for given accelerations, its Newton increments
statics                     assembled start state and preload
status                      what can happen to an assembly or a run
algebra                     vectors, rotations, spatial vectors
products, reordering        products of these, rows exchanged, repeated, summed: each one operation to JAX
"""

from rfem_jax.mechanics.designs import Design, design, designed, parameters
from rfem_jax.mechanics.discretisation import Structure, describe, discretise
from rfem_jax.mechanics.model import Coordinates, Model, State
from rfem_jax.mechanics.model_with_errors import AssemblyErrors, assembly_errors
from rfem_jax.mechanics.statics.assembly import Assembled, Load, assemble
from rfem_jax.mechanics.status import STATUS

__all__ = [
    "STATUS",
    "Assembled",
    "AssemblyErrors",
    "Coordinates",
    "Design",
    "Load",
    "Model",
    "State",
    "Structure",
    "assemble",
    "assembly_errors",
    "describe",
    "design",
    "designed",
    "discretise",
    "parameters",
]
