"""A study as a script for Exudyn, whose loads can be put beside ours.

Place in the pipeline: `load_study` -> **exudyn_writer** (with the text of `exudyn_program`) -> a script.

Only numbers are shared: masses, inertias, frames of joints with the errors of a case, stiffnesses, and the start (our
assembly at rest, with the rates of a prescribed motion). Kinematics, element, constraints and integration are Exudyn's.
"""

import json
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.drives.family import GivenDrive
from rfem_jax.description.mechanism.forces import JointSpring
from rfem_jax.description.mechanism.point_forces import PointSpring
from rfem_jax.description.mechanism.sections import CoupledSection
from rfem_jax.description.study_file.study import Study
from rfem_jax.exchange.rigid_frames import Frame
from rfem_jax.mechanics.kinematics.motion import all_frames, motion_of
from rfem_jax.mechanics.laws.point_laws import SpringBetween
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import BASE, Model, State
from rfem_jax.mechanics.model.status import OK, STATUS
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.statics.designs import designed, model_of_study
from rfem_jax.simulation.integration import prepare

STEPS = 2000  # of the whole duration, at least
_KINDS = ("revolute", "prismatic", "cylindrical", "spherical", "planar", "fixed", "free")
_AXES = {"z": 0, "x": 1, "y": 2}  # of ours in the turned frames of joints there
_prepared = eqx.filter_jit(prepare)


def exudyn_text(study: Study, case: str | None, source: str) -> str:
    """The script of a study with the errors of a case (None: perfect).

    **Raises:** `InputError` for what such a script does not have, and where the mechanism cannot be assembled.
    """
    _require_translated(study)
    duration = study.require_duration()
    errors = {} if case is None else study.case(case).errors
    # The start of elements that are as Exudyn's, or stiff links ring along their axes at first.
    exact = replace(study, mechanism=replace(study.mechanism, elements="geometrically_exact"), statics=None)
    model = model_of_study(exact)
    if model.topology.redundant:
        raise InputError(
            "A script for Exudyn must do without redundant constraints, for which its solver has no answer, but the "
            "study has some; make a link flexible."
        )
    made = designed(model, None, assembly_errors(model, errors))
    drive = study.designed_drive
    start = _prepared(made.model, made.errors, drive, None)
    if int(start.status) != OK:
        reason = STATUS[int(start.status)].message
        raise InputError(f"The mechanism must be assembled to be exported, but is not: {reason}")
    if made.model.topology.slender:
        raise InputError(
            "A script for Exudyn must do without links that neither stretch nor shear, but the study has some; leave "
            "`flexibility` out."
        )
    if start.actual.bent is not None:
        raise InputError(
            "A script for Exudyn must do without temperature gradients, which bend links without load, but the study "
            "has some; leave them out."
        )
    given = drive is None or isinstance(drive, GivenDrive)
    content = {
        "gravity": np.asarray(made.model.gravity),
        "bodies": _bodies(start.actual, start.state),
        "elements": _elements(start.actual),
        "springs": _springs(start.actual),
        "joints": _joints(study, made.model, start.actual, np.asarray(start.state.position.joints)),
        "drive": _drive(study, made.model, np.asarray(start.state.position.joints)),
        "pieces": _pieces(drive, duration),
        "known": given,
        "tolerance": max(1e-7, 4e-16 * float(np.max(np.asarray(start.actual.stiffness), initial=0.0))),
    }
    program = Path(__file__).with_name("exudyn_program.py").read_text(encoding="utf-8")
    rest = program.split('"""', 2)[2]
    numbers = _literal(content)
    return f'"""{source}: a script for Exudyn; SI units, rad."""\n\nMECHANISM = {numbers}\n{rest}'


def _literal(content: Any) -> str:
    """Numbers as Python reads them."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(one) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(one) for one in value]
        return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value

    text = json.dumps(plain(content), indent=1, allow_nan=False)
    return f'__import__("json").loads(r"""\n{text}\n""")'


def _require_translated(study: Study) -> None:
    mechanism = study.mechanism
    others = [f"`{one.name}`" for one in mechanism.forces if not isinstance(one, JointSpring | PointSpring)]
    kinds = [f"`{one.name}` ({one.kind})" for one in mechanism.joints if one.kind not in _KINDS]
    loose = [f"`{one.name}`" for one in mechanism.joints if one.compliance is not None or one.clearance is not None]
    turning = [
        f"`{one.name}`" for one in mechanism.forces
        if isinstance(one, JointSpring) and one.motion == "R_y" and mechanism.joint(one.joint).kind != "revolute"
    ]  # fmt: skip
    told = {
        "forces other than springs": others,
        "links with an axis or errors of form": [
            f"`{link.name}`" for link in mechanism.links if link.axis or link.form_errors
        ],
        "sections that couple bending, shear and torsion": [
            f"`{link.name}`"
            for link in mechanism.links
            if any(isinstance(one, CoupledSection) for one in link.sections)
        ],
        "joints of these kinds": kinds,
        "compliant joints and clearances": loose,
        "torsion springs in joints other than hinges": turning,
        "free bodies alone": [f"`{one.name}`" for one in mechanism.joints]
        if all(one.kind == "free" for one in mechanism.joints)
        else [],
        "several drives": [f"`{label}`" for label in study.drive_labels] if len(study.drives) > 1 else [],
    }
    for words, names in told.items():
        if names:
            raise InputError(
                f"A script for Exudyn must do without {words}, but the study has {', '.join(names)}; export a study "
                "without them."
            )
    if not study.drives:
        return
    joint = mechanism.joint(study.drives[0].joint)
    if joint.kind not in ("revolute", "prismatic"):
        raise InputError(
            f"A script for Exudyn must have its drive at a hinge or a slide, but `{joint.name}` is {joint.kind}; drive "
            "another joint."
        )
    if isinstance(study.drive, GivenDrive) and joint.kind == "prismatic" and joint.parent != "base":
        raise InputError(
            f"A script for Exudyn must have a driving force between the base and a link, but `{joint.name}` joins two "
            "links; prescribe its motion."
        )


def _bodies(actual: ModelWithErrors, state: State) -> list[dict[str, Any]]:
    """All rfes, links first: mass, inertia, place and velocity of the centre of mass."""
    motion = motion_of(actual, state)
    rotation, point = (np.asarray(one) for one in all_frames(actual.topology, motion))
    n, link = actual.topology.n_links, np.asarray(actual.topology.link_of_rfe, dtype=int)
    velocity = np.asarray(motion.links.velocity)
    angular, linear = velocity[:3], velocity[3:]
    of_links = np.moveaxis(rotation[:, :, :n], 2, 0)
    turning = np.einsum("kij,jk->ik", of_links[link], np.asarray(motion.relative.angular))
    moving = np.einsum("kij,jk->ik", of_links[link], np.asarray(motion.relative.linear))
    free = moving + np.cross(point[:, n:], turning, axis=0)
    angular = np.concatenate([angular, angular[:, link] + turning], axis=1)
    linear = np.concatenate([linear, linear[:, link] + free], axis=1)
    found = []
    for i in range(rotation.shape[2]):
        centre = point[:, i] + rotation[:, :, i] @ np.asarray(actual.centre)[:, i]
        found.append({
            "mass": float(actual.mass[i]), "inertia": np.asarray(actual.inertia)[:, :, i], "centre": centre,
            "rotation": rotation[:, :, i], "velocity": linear[:, i] + np.cross(angular[:, i], centre),
            "angular": angular[:, i],
        })  # fmt: skip
    return found


def _elements(actual: ModelWithErrors) -> list[dict[str, Any]]:
    """The spring-damping elements, with their points from the centres of mass."""
    topology, centre = actual.topology, np.asarray(actual.centre)
    stiffness, found = np.asarray(actual.stiffness), []
    for link, (first, stop) in enumerate(topology.ranges):
        for k in range(first, stop):
            left, right = link if k == first else topology.n_links + k - 1, topology.n_links + k
            start = float(actual.beam_middle[link]) if k == first else 0.0
            levers = start + float(actual.lever_left[k]), float(actual.lever_right[k])
            points = [np.array([x, 0.0, 0.0]) - centre[:, node] for x, node in zip(levers, (left, right))]
            found.append({
                "bodies": [left, right], "points": points, "stiffness": stiffness[:, k],
                "damping": float(actual.damping[k]),
            })  # fmt: skip
    return found


def _from_centre(actual: ModelWithErrors, node: int, place: Any) -> np.ndarray:
    """A place on a node from its centre of mass; of the base as it is."""
    return np.asarray(place) - (0.0 if node == BASE else np.asarray(actual.centre)[:, node])


def _springs(actual: ModelWithErrors) -> list[dict[str, Any]]:
    elements = {} if actual.frame_forces is None else actual.frame_forces.elements
    found = []
    for one in elements.values():
        assert isinstance(one, SpringBetween), "others have been refused"
        ends = (one.parent, one.child)
        found.append({
            "bodies": [end.node for end in ends],
            "points": [_from_centre(actual, end.node, end.position) for end in ends],
            "stiffness": float(one.stiffness), "damping": float(one.damping), "length": float(one.free_length),
            "preload": float(one.preload),
        })  # fmt: skip
    return found


def _joints(study: Study, model: Model, actual: ModelWithErrors, start: np.ndarray) -> list[dict[str, Any]]:
    topology, found = model.topology, []
    for j, name in enumerate(topology.joints):
        sides = []
        for nodes, rotations, places in (
            (topology.parents, actual.seat_rotation, actual.seat_position),
            (topology.children, actual.bore_rotation, actual.bore_position),
        ):
            rotation, place = np.asarray(rotations)[:, :, j], np.asarray(places)[:, j]
            frame = Frame(rotation, _from_centre(actual, nodes[j], place))
            sides.append({"body": nodes[j], "rotation": frame.rotation, "point": frame.position})
        springs = []
        for one in study.mechanism.forces:
            if isinstance(one, JointSpring) and one.joint == name:
                springs.append(_spring_of(one, topology.kinds[j], start[topology.positions[j].start :]))
        found.append({
            "name": name, "kind": topology.kinds[j], "seat": sides[0], "bore": sides[1], "springs": springs,
        })  # fmt: skip
    return found


def _spring_of(one: JointSpring, kind: str, start: Sequence[float] | np.ndarray) -> dict[str, Any]:
    motion = str(one.motion)
    names = ("stiffness", "damping", "rest", "preload")
    return {name: float(np.asarray(getattr(one, name))) for name in names} | {
        "rotation": motion[0] == "R",
        "axis": _AXES[motion[2]],
        "start": float(start[0]) if kind == "revolute" else 0.0,
    }


def _drive(study: Study, model: Model, start: np.ndarray) -> dict[str, Any] | None:
    if not study.drives:
        return None
    one, motion = study.drives[0], study.drive_motions[0]
    return {
        "joint": one.joint,
        "prescribed": not isinstance(one, GivenDrive),
        "rotation": motion[0] == "R",
        "axis": _AXES[motion[2]],
        "start": float(start[model.topology.positions[model.topology.joints.index(one.joint)].start]),
    }


def _pieces(drive: Any, duration: float) -> list[dict[str, Any]]:
    """Values of the drive at ends of equal steps, from one of its jumps to the next."""
    jumps = [] if drive is None else [float(one) for one in drive.breakpoints() if 0.0 < one < duration]
    found = []
    for phase, (begin, end) in enumerate(pairwise([0.0, *jumps, duration])):
        count = max(10, round(STEPS * (end - begin) / duration))
        times = jnp.linspace(begin, end, count + 1)
        if drive is None:
            values = np.zeros(count + 1)
        elif isinstance(drive, GivenDrive):
            values = np.asarray(jax.vmap(lambda t, phase=phase: drive.force_at(t, phase))(times))
        else:
            values = np.asarray(jax.vmap(lambda t, phase=phase: drive.motion_at(t, phase)[0])(times))
        found.append({"begin": begin, "end": end, "values": values})
    return found


def verified(text: str, study: Study, case: str | None) -> dict[str, tuple[float, float, float, float]]:
    """RMS loads by joints: force by us and by Exudyn [N], moment by us and by Exudyn [N m], of a script and its study.

    **Raises:** `InputError` where `exudyn` is not installed, or fails.
    """
    names: dict[str, Any] = {"__name__": "script"}
    exec(compile(text, "the script for Exudyn", "exec"), names)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of names that later versions have otherwise
            force, moment = names["rms_loads"]()
    except ImportError:
        raise InputError(
            "The package exudyn must be there to verify, but cannot be imported; install it with "
            '`pip install "rfem_jax[bench]"`.'
        ) from None
    except RuntimeError as problem:  # of Exudyn's solver
        reason = " ".join(str(problem).split())[:200]
        raise InputError(f"Exudyn must be able to run the script to verify it, but says: {reason}") from None
    from rfem_jax.simulation import run_cases

    _, runs = run_cases(replace(study, cases=(study.case(case),) if case is not None else ()))
    run = next(iter(runs.values()))
    ours = run.metrics
    return {
        name: (float(ours.rms_force[name]), force[name], float(ours.rms_moment[name]), moment[name]) for name in force
    }
