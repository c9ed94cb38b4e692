"""Force elements, loads along links and points whose paths are followed, on links with errors.

Place in the pipeline: frames_with_errors -> **carried_frames** -> with_errors.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.laws.frame_forces import FrameForce, NodeFrame
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.model.form import FormErrors, Held
from rfem_jax.mechanics.model.frames_with_errors import displaced, stretched
from rfem_jax.mechanics.model.model import CarriedPoint, Model
from rfem_jax.mechanics.model.topology import BASE, Topology


class FrameForceSet(eqx.Module):
    """All force elements of a mechanism, by their names; share: of their full wrenches, for load steps; lines: loads
    along links, which have their share likewise, None without any."""

    elements: dict[str, FrameForce]
    share: Float[Array, ""]
    lines: dict[str, LineLoad] | None = None


def placed_frame_forces(
    model: Model, form: FormErrors | None, scale: Array, sides: tuple[tuple[Array, Array], tuple[Array, Array]]
) -> FrameForceSet | None:
    """The force elements, whose frames lie on links that are `scale` times as long, or are those of joints: rotations
    (3, 3, joints) and positions (3, joints) on both `sides`."""
    if model.frame_forces is None and model.line_loads is None:
        return None
    elements, topology = {}, model.topology
    at_joints = {clearance_name(topology.joints[j]): j for j in topology.clearances}
    for name, element in (model.frame_forces or {}).items():
        if name in at_joints:
            j, ends = at_joints[name], (element.parent, element.child)
            frames = [NodeFrame(end.node, side[0][:, :, j], side[1][:, j]) for end, side in zip(ends, sides)]
        else:
            ends = (element.parent, element.child)
            if model.form is not None and name in model.form.elements:
                held = model.form.elements[name]
                several = [jax.tree.map(lambda x, k=k: x[..., k : k + 1], held) for k in range(held.share.shape[0])]
                ends = [_displaced_frame(model, form, *end) for end in zip(ends, [None, *several][-2:])]
            frames = [_scaled_frame(topology, frame, scale) for frame in ends]
        elements[name] = eqx.tree_at(lambda one: (one.parent, one.child), element, tuple(frames))
    return FrameForceSet(elements, jnp.ones(()), _line_loads(model, scale))


def _displaced_frame(model: Model, form: FormErrors | None, frame: NodeFrame, held: Held | None) -> NodeFrame:
    if held is None:
        return frame
    moved = displaced(model, form, frame.position[:, None], [frame.node], held)
    return NodeFrame(frame.node, frame.rotation, moved[:, 0])


def _line_loads(model: Model, scale: Array) -> dict[str, LineLoad] | None:
    """The loads along links that became `scale` times as long."""
    if model.line_loads is None:
        return None
    stretched = {}
    for name, line in model.line_loads.items():
        ends = line.begin * scale[line.link], line.end * scale[line.link]
        stretched[name] = eqx.tree_at(lambda one: (one.begin, one.end), line, ends)
    return stretched


def _scaled_frame(topology: Topology, frame: NodeFrame, scale: Array) -> NodeFrame:
    """A frame on a link that became `scale` times as long."""
    if frame.node == BASE:
        return frame
    return NodeFrame(frame.node, frame.rotation, stretched(topology, frame.node, frame.position, scale))


def placed_points(
    model: Model, form: FormErrors | None, scale: Array, centres: Float[Array, "3 joints"]
) -> dict[str, CarriedPoint] | None:
    """The points whose paths are followed, on links that became `scale` times as long; `centres` of the joints on
    their children."""
    if model.points is None:
        return None

    def place(one: CarriedPoint) -> Array:
        if form is None or model.form is None or one.node == BASE:
            return one.position
        # Of straight links alone, which may have errors of form.
        link = model.topology.link_of(one.node)
        share = jnp.clip(model.form.middles.share[one.node] + one.position[0] / model.length[link], 0.0, 1.0)[None]
        _, camber = model.form.lines.of(link)
        held = Held(share, None if camber is None else camber.at(share * model.length[link]))
        return displaced(model, form, one.position[:, None], [one.node], held)[:, 0]

    return {
        name: CarriedPoint(
            one.node,
            one.observer,
            stretched(model.topology, one.node, place(one), scale) if one.joint is None else centres[:, one.joint],
            one.joint,
        )
        for name, one in model.points.items()
    }
