"""What the user specifies: materials, sections, links, joints, the mechanism, its drive, a study.

Place in the pipeline: the first package; imports nothing of the others. Everything is checked where it
enters and converted to SI floats. A room for each subject, from the bottom:

basics       units, sentences of errors, tables of files, kinds of joints
drives       what moves a mechanism, along angles and lengths
mechanism    materials, sections, links, joints, springs and forces, and the mechanism of them
bodies       reduced bodies of links, from the matrices of a mesh and from files
methods      methods of integration
tolerances   names of errors, tolerances, zones of drawings
metrics      what is asked of a run
parameters   every number of a description by a name; deviations and designs
tasks        what is asked of a study
study_file   a study, its reader, and what is told about its keys
"""

import warnings

from rfem_jax.description.basics.errors import InputError, nearest
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.bodies.body_files import load_body, save_body
from rfem_jax.description.bodies.reduction import Interface, craig_bampton
from rfem_jax.description.drives.rotations import (
    GivenDrive,
    MomentDrive,
    MomentFunction,
    MomentRamp,
    MomentTable,
    PrescribedDrive,
    PrescribedFunction,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
)
from rfem_jax.description.drives.translations import (
    ForceDrive,
    ForceFunction,
    ForceRamp,
    ForceTable,
    PrescribedDisplacements,
    PrescribedRunUp,
    PrescribedSpeed,
)
from rfem_jax.description.mechanism.axes import AxisPoint
from rfem_jax.description.mechanism.bases import Base
from rfem_jax.description.mechanism.bearings import Bearing
from rfem_jax.description.mechanism.cambers import CamberPoint
from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.description.mechanism.compliance import Compliance
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.forces import JointForceFunction, JointForceTable, JointFriction, JointSpring
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link, PointMass
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.point_forces import (
    PointForce,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    PointSpringTable,
)
from rfem_jax.description.mechanism.points import Point
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.section_bases import SectionProperties
from rfem_jax.description.mechanism.sections import (
    AngleSection,
    ChannelSection,
    Circle,
    CompositeSection,
    GivenSection,
    HollowRectangle,
    ISection,
    PolygonSection,
    Rectangle,
    Section,
    TeeSection,
    Tube,
)
from rfem_jax.description.mechanism.stations import Station
from rfem_jax.description.methods import (
    Automatic,
    Explicit,
    FixedStep,
    GeneralisedAlpha,
    Leapfrog,
    Method,
    RungeKutta4,
)
from rfem_jax.description.metrics import coupling_metrics as coupling_metrics
from rfem_jax.description.metrics import design_metrics as design_metrics  # they register themselves
from rfem_jax.description.metrics import path_metrics as path_metrics
from rfem_jax.description.metrics import shaking_metrics as shaking_metrics
from rfem_jax.description.study_file.study import Case, Study, load_study
from rfem_jax.description.tasks.identification import Sensor

__all__ = [
    "AngleSection",
    "Automatic",
    "AxisPoint",
    "Base",
    "Bearing",
    "CamberPoint",
    "Case",
    "ChannelSection",
    "Circle",
    "Clearance",
    "Compliance",
    "CompositeSection",
    "Coupling",
    "DistributedForce",
    "Explicit",
    "FixedStep",
    "ForceDrive",
    "ForceFunction",
    "ForceRamp",
    "ForceTable",
    "GeneralisedAlpha",
    "GivenDrive",
    "GivenSection",
    "HollowRectangle",
    "ISection",
    "InputError",
    "Interface",
    "Joint",
    "JointForceFunction",
    "JointForceTable",
    "JointFriction",
    "JointSpring",
    "Leapfrog",
    "Link",
    "Material",
    "Mechanism",
    "Method",
    "MomentDrive",
    "MomentFunction",
    "MomentRamp",
    "MomentTable",
    "Point",
    "PointForce",
    "PointMass",
    "PointMoment",
    "PointSpring",
    "PointSpringFunction",
    "PointSpringTable",
    "PolygonSection",
    "PrescribedDisplacements",
    "PrescribedDrive",
    "PrescribedFunction",
    "PrescribedRate",
    "PrescribedRunUp",
    "PrescribedSpeed",
    "PrescribedSpinUp",
    "PrescribedTable",
    "Rectangle",
    "ReducedBody",
    "RigidBody",
    "RungeKutta4",
    "Section",
    "SectionProperties",
    "Sensor",
    "Station",
    "Study",
    "TeeSection",
    "Tube",
    "craig_bampton",
    "load_body",
    "load_study",
    "nearest",
    "quantity",
    "save_body",
]

_FORMER_NAMES = {
    "AutomaticMethod": Automatic,
    "DiffraxMethod": Explicit,
    "FixedStepMethod": FixedStep,
    "GeneralisedAlphaMethod": GeneralisedAlpha,
}


def __getattr__(name: str) -> type[Method]:
    """Names of the version before, which a later one refuses."""
    if name not in _FORMER_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now = _FORMER_NAMES[name]
    warnings.warn(f"`{name}` is called `{now.__name__}` now.", DeprecationWarning, stacklevel=2)
    return now
