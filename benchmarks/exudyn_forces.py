"""Springs, friction and forces of a model as plain numbers in Exudyn's axes.

Place in the pipeline: exudyn_models reads a model with it; exudyn_joints adds springs and laws of joints, this module
springs between points.

Axes as in `exudyn_engine`: (x, y, z) there = (z, x, y) here.  Units: SI, rad.
"""

import numpy as np
from exudyn_engine import BACK, TURNED, exut

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.mechanics.laws.point_laws import SpringBetween
from rfem_jax.mechanics.model.model import BASE, Model


def springs_of(model: Model, j: int):
    """Stiffnesses and dampings (6,) of a compliant joint and its sprung motions, or None and ()."""
    topology = model.topology
    if not topology.sprung or not topology.sprung[j]:
        return None, ()
    kind, rows = KINDS[topology.kinds[j]], np.zeros((2, 6))
    turns = {motion for motion in topology.sprung[j] if motion[0] == "R"}
    if turns and (kind.angles > 1 or turns != set(kind.turns_held)):
        raise NotImplementedError(
            f"Joint {topology.joints[j]}: rotations that are sprung are translated only of a joint with at most one "
            "rotation, and all of them."
        )
    for name, spring in (model.springs or {}).items():
        joint, direction = name.split(".")
        if joint != topology.joints[j]:
            continue
        if spring.positions is not None:
            raise NotImplementedError(f"The table of spring {name} is not translated.")
        for motion in kind.directions[direction]:
            at = BACK["xyz".index(motion[2])] + (3 if motion[0] == "R" else 0)
            rows[:, at] = float(spring.stiffness), float(spring.damping)
    return (rows[0], rows[1]), topology.sprung[j]


def laws_of(model: Model, j: int) -> tuple:
    """Laws along motions of a joint of the tree, and friction in a joint: (law, motion, start)."""
    topology, found = model.topology, []
    for law in (model.forces or {}).values():
        if topology.link_of_freedom[law.coordinate] == j:
            found.append((law, topology.motion_of(law.coordinate), float(model.start_joints[law.place])))
    for law in (model.friction or {}).values():
        if law.joint == j:
            start = 0.0 if law.place is None else float(model.start_joints[law.place])
            found.append((law, f"{'TR'[law.component // 3]}_{'xyz'[law.component % 3]}", start))
    return tuple(found)


def point_springs_of(actual, centre) -> tuple:
    """Springs between points: (bodies, points on them, stiffness, damping, free length, preload) each; centre (n, 3):
    centres of mass of the bodies."""
    found = []
    for spring in (actual.frame_forces.elements if actual.frame_forces is not None else {}).values():
        if not isinstance(spring, SpringBetween):
            raise NotImplementedError(f"A {type(spring).__name__} is not translated.")
        nodes = spring.parent.node, spring.child.node
        points = [
            (np.asarray(end.position) - (0.0 if end.node == BASE else centre[end.node]))[TURNED]
            for end in (spring.parent, spring.child)
        ]
        numbers = (float(x) for x in (spring.stiffness, spring.damping, spring.free_length, spring.preload))
        found.append((nodes, points, *numbers))
    return tuple(found)


def add_point_springs(mbs, springs: tuple, marker) -> None:
    """Add them; `marker(body, point)` adds a marker of a body."""
    for nodes, points, stiffness, damping, length, preload in springs:
        mbs.AddObject(
            exut.ObjectConnectorSpringDamper(
                markerNumbers=[marker(node, point) for node, point in zip(nodes, points, strict=True)],
                stiffness=stiffness,
                damping=damping,
                referenceLength=length,
                force=preload,
            )
        )
