"""What acts on the mechanism beside its joints, for the page: forces and springs at points, springs and laws in joints.

Place in the pipeline: runs and their model -> **acting** -> animation.

Forces at points are described by their name, kind ("spring" between two points, "force", "moment") and the links that
they act on, and have arrays over time: force_first, force_place [m], the points, and force_value [N, N m], what acts at
the second one. Of a load along a link this is all of its force, at the middle of the loaded piece. A spring or a law in
a joint of the tree has its name, the joint and the motion that it acts along.
"""

from typing import Any

import numpy as np

from rfem_jax.mechanics.laws.point_laws import GivenLoad
from rfem_jax.report.contents.annotations import Run

ACTING = ("force_first", "force_place", "force_value")


def owner_of(topology: Any, node: int) -> str:
    """The link that a node is part of, "base" for none."""
    return "base" if node < 0 else topology.links[topology.link_of(node)]


def describe_acting(run: Run) -> dict[str, Any]:
    """{"forces": at points, in the order of `run.forces`; "laws": in joints} of a run that has a model."""
    model = run.model
    assert model is not None, "it is asked of such runs"
    topology, elements, lines = model.topology, model.frame_forces or {}, model.line_loads or {}
    forces = []
    for name in run.forces:
        if name in lines:
            forces.append({"name": name, "kind": "force", "links": [topology.links[lines[name].link]]})
            continue
        element = elements[name]
        given = isinstance(element, GivenLoad)
        sides = [owner_of(topology, side.node) for side in (element.parent, element.child)]
        kind = ("moment" if element.moment else "force") if given else "spring"
        forces.append({"name": name, "kind": kind, "links": sides[1:] if given else sides})
    laws = [
        {
            "name": name,
            "spring": law.inside,
            "joint": topology.joints[topology.link_of_freedom[law.coordinate]],
            "motion": topology.motion_of(law.coordinate),
        }
        for name, law in (model.forces or {}).items()
    ]
    return {"forces": forces, "laws": laws}


def acting_arrays(run: Run, forces: list[dict[str, Any]], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Points and values of the forces that `describe_acting` tells, at some of the saved times."""
    if not forces:
        return {name: np.zeros((len(rows), 0, 3)) for name in ACTING}
    histories = [run.forces[one["name"]] for one in forces]
    values = [history.moment if one["kind"] == "moment" else history.force for one, history in zip(forces, histories)]
    parts = [one.first_place for one in histories], [one.place for one in histories], values
    return {name: np.stack([np.asarray(one)[rows] for one in part], axis=1) for name, part in zip(ACTING, parts)}
