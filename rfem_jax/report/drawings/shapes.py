"""Picture of the assembled mechanism: centre lines in 3D with deflections exaggerated.

Place in the pipeline: called by `figures`; `joint_symbols` draws joints and forces.
`run.motion.centre_lines[LINK]` (P, 3) m are the links at the start of the run, `run.motion.nominal_lines[LINK]` (P, 3)
m those of the perfect, undeformed mechanism; what is drawn is nominal + factor * (assembled - nominal).
"""

import math
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.forces import JointForce
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Axes3D, Figure, Model, Run
from rfem_jax.report.contents.summary import in_legend, status_of
from rfem_jax.report.drawings.force_shapes import draw_forces, forces_at_start
from rfem_jax.report.drawings.joint_symbols import (
    Seat,
    draw_force,
    draw_guides,
    draw_joint,
    guide_ends,
    joint_seats,
    legend_handles,
)
from rfem_jax.report.drawings.style import CASE_COLOURS, LINE_STYLES, add_titles, new_figure

_VIEWS = {"xz": (22.0, -48.0), "xy": (70.0, -90.0)}  # elevation and azimuth [deg], by the plane of the mechanism
_MOST_PANELS = 6
_LEGEND_ROW, _LEGEND_FOOT = 0.1875, 0.45  # inches
SAME_PLACE = 0.02  # of the longest line
ARM = 0.01  # of the mechanism's size: a shorter one is not drawn
_SHARE = 0.2

Line = Float[np.ndarray, "points 3"]
Point = Float[np.ndarray, " 3"]
Guides = Mapping[str, list[tuple[Point, Point]]]  # {joint: the ends of its guides}


def round_factor(value: float) -> float:
    """Largest of 1, 2, 5, 10, 20, 50, ... that is not above `value`; at least 1."""
    if not math.isfinite(value) or value <= 1.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    step = max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1.0 + 1e-12))
    return step * power


def largest_deflection(run: Run) -> float:
    """Largest distance of an assembled from its nominal point, m (NaN for a failed run)."""
    lines = run.motion.nominal_lines
    return max(
        float(np.linalg.norm(np.asarray(run.motion.centre_lines[link]) - lines[link], axis=1).max()) for link in lines
    )


def exaggeration(runs: Mapping[str, Run]) -> float:
    """Factor that makes the largest deflection a fifth of the mechanism's size at most."""
    deflections = [largest_deflection(run) for run in runs.values()]
    deflection = max((value for value in deflections if math.isfinite(value)), default=0.0)
    first = next(iter(runs.values()))
    points = np.concatenate([np.asarray(line) for line in first.motion.nominal_lines.values()])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    # Below a millionth of the size there is nothing to see but rounding.
    return round_factor(_SHARE * size / deflection) if deflection > 1e-6 * size else 1.0


def exaggerated_lines(run: Run, factor: float) -> dict[str, Line]:
    """Centre lines of one run with deflections times `factor`, {link: (P, 3) m}."""
    lines = {}
    for link, nominal in run.motion.nominal_lines.items():
        nominal = np.asarray(nominal)
        lines[link] = nominal + factor * (np.asarray(run.motion.centre_lines[link]) - nominal)
    return lines


def point_on_line(line: Line, nominal: Line, x: float) -> Point:
    """The point of an assembled centre line that is x [m] from the origin of its link, (3,) m.

    `nominal` is the straight line of the same points, which need not be equally spaced; beyond its ends (a rigid link
    may have joints there) the line goes on straight.
    """
    places = np.linalg.norm(nominal - nominal[0], axis=1)
    piece = int(np.clip(np.searchsorted(places, x, side="right") - 1, 0, len(places) - 2))
    share = (x - places[piece]) / (places[piece + 1] - places[piece])
    return line[piece] + share * (line[piece + 1] - line[piece])


def seats(mechanism: Mechanism, joint: Joint) -> list[tuple[str, Point]]:
    """[(link, position of the joint in its frame (3,) m)]: in the child, and in the parent if that is no base."""
    child = joint.child_position
    if child is None:
        child = (mechanism.link(joint.child).length if joint.cut else 0.0, 0.0, 0.0)
    found = [(joint.child, np.array(child))]
    if joint.parent != "base":
        parent = joint.position
        if parent is None:
            parent = (mechanism.link(joint.parent).length, 0.0, 0.0)
        found.append((joint.parent, np.array(parent)))
    return found


def joint_point(mechanism: Mechanism, joint: Joint, lines: Mapping[str, Line], nominal: Mapping[str, Line]) -> Point:
    """Where `joint` is, (3,) m: on the centre line of a link whose axis it lies on. A joint that is off the axes of all
    its links is drawn between the nearest points of their lines (a joint of the base at its nominal place)."""
    found = seats(mechanism, joint)
    places = [point_on_line(lines[link], nominal[link], float(seat[0])) for link, seat in found]
    for place, (_, seat) in zip(places, found, strict=True):
        if not np.any(seat[1:]):
            return place
    if joint.parent == "base" and KINDS[joint.kind].coincident:
        return np.array(joint.position or (0.0, 0.0, 0.0))
    return np.mean(places, axis=0)


def _limits(runs: Mapping[str, Run], factor: float, guides: Guides) -> tuple[Point, Point]:
    """Lower and upper corner (3,) of a box around all that is drawn, no side too thin."""
    lines = [np.asarray(line) for run in runs.values() for line in run.motion.nominal_lines.values()]
    return _box([*lines, *(line for run in runs.values() for line in exaggerated_lines(run, factor).values())], guides)


def _box(lines: Iterable[Line], guides: Guides) -> tuple[Point, Point]:
    """Corners of a box around lines and guides."""
    points = np.concatenate([*lines, *(np.stack(ends) for some in guides.values() for ends in some)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2.0, 0.55 * (high - low)
    half = np.maximum(half, 0.35 * half.max())
    return middle - half, middle + half


def _draw_mechanism(
    axes: Axes3D, mechanism: Mechanism, run: Run, factor: float, places: Mapping[str, Seat], guides: Guides
) -> None:
    """Nominal lines thin and grey, assembled lines thick, joints with their symbols and names, forces."""
    # In the order of what lies on what: by depth, short lines would hide behind long ones.
    axes.computed_zorder = False
    lines = exaggerated_lines(run, factor)
    colours = {link: CASE_COLOURS[(index + 1) % len(CASE_COLOURS)] for index, link in enumerate(lines)}
    _draw_links(axes, run, lines, colours)
    nominal = {link: np.asarray(line) for link, line in run.motion.nominal_lines.items()}
    size = mechanism_size(nominal)
    points = _draw_joints(axes, mechanism, (lines, nominal), colours, places, guides)

    def drawn(link: str, x: float, place: Point) -> Point:
        """Where a point of a link is drawn: as far from its centre line as it is, but that line exaggerated."""
        if link == "base":
            return place
        assembled = np.asarray(run.motion.centre_lines[link])
        return place + point_on_line(lines[link], nominal[link], x) - point_on_line(assembled, nominal[link], x)

    if mechanism.point_forces:
        draw_forces(axes, mechanism, run.forces, size, drawn)
    _write_names(axes, mechanism, points, lines)


def _draw_joints(
    axes: Axes3D,
    mechanism: Mechanism,
    drawn: tuple[Mapping[str, Line], Mapping[str, Line]],
    colours: Mapping[str, str],
    places: Mapping[str, Seat],
    guides: Guides,
) -> dict[str, Point]:
    """Draw joints, and the forces in them, on links of which the lines are drawn, and the nominal ones; returns their
    points."""
    lines, nominal = drawn
    size, points = mechanism_size(nominal), {}
    # Sliders first, so that a pin in one of them is seen.
    for joint in sorted(mechanism.joints, key=lambda joint: KINDS[joint.kind].coincident):
        point = joint_point(mechanism, joint, lines, nominal)
        for link, seat in seats(mechanism, joint):
            # An arm where the joint is off the axis of the link, by design or by its errors.
            foot = point_on_line(lines[link], nominal[link], float(seat[0]))
            if np.linalg.norm(point - foot) > ARM * size or np.any(seat[1:]):
                axes.plot(*np.stack([foot, point], axis=1), color=colours[link], linewidth=1.2)
        draw_guides(axes, joint, guides.get(joint.name, []))
        draw_joint(axes, joint, point, places.get(joint.name), size)
        points[joint.name] = point
    for force in mechanism.forces:
        if isinstance(force, JointForce) and force.joint in places and np.isfinite(points[force.joint]).all():
            draw_force(axes, mechanism, force, points[force.joint], places[force.joint], size)
    return points


def _write_names(axes: Axes3D, mechanism: Mechanism, points: Mapping[str, Point], lines: Mapping[str, Line]) -> None:
    for names, point in labelled_points({joint.name: points[joint.name] for joint in mechanism.joints}, lines):
        axes.text(point[0], point[1], point[2], f"  {', '.join(names)}", fontsize=9, weight="bold", zorder=6)


def _draw_links(axes: Axes3D, run: Run, lines: Mapping[str, Line], colours: Mapping[str, str]) -> None:
    for index, link in enumerate(lines):
        nominal = np.asarray(run.motion.nominal_lines[link])
        label = "perfect mechanism" if index == 0 else None
        axes.plot(*nominal.T, color="#808080", linestyle=":", linewidth=1.2, label=label)
        style = LINE_STYLES[index % len(LINE_STYLES)]
        axes.plot(*lines[link].T, color=colours[link], linestyle=style, linewidth=2.2, label=link)
        # Thin rungs from the perfect to the assembled line show the direction of the deflection.
        for start, end in zip(nominal[::2], lines[link][::2], strict=True):
            axes.plot(*np.stack([start, end], axis=1), color=colours[link], linewidth=0.5)


def mechanism_size(lines: Mapping[str, Line]) -> float:
    """The longest side of a box around the lines, m."""
    return float(np.ptp(np.concatenate(list(lines.values())), axis=0).max())


def labelled_points(points: Mapping[str, Point], lines: Mapping[str, Line]) -> list[tuple[list[str], Point]]:
    """Names of joints and their points; joints that are drawn on one another have one label."""
    size = max(np.ptp(line, axis=0).max() for line in lines.values())
    found: list[tuple[list[str], Point]] = []
    for name, point in points.items():
        if not np.isfinite(point).all():
            continue
        near = [names for names, other in found if np.linalg.norm(other - point) < SAME_PLACE * size]
        if near:
            near[0].append(name)
        else:
            found.append(([name], point))
    return found


def _format_axes(axes: Axes3D, low: Point, high: Point, plane: str) -> None:
    from matplotlib.ticker import MaxNLocator

    for axis, letter, lower, upper in zip("xyz", "XYZ", low, high, strict=True):
        axes.set(**{f"{axis}lim": (lower, upper), f"{axis}label": f"{letter}, m"})
        getattr(axes, f"{axis}axis").set_major_locator(MaxNLocator(3))
    axes.xaxis.labelpad = 7.0  # clear of its numbers where the mechanism is long and thin
    axes.set_box_aspect(high - low, zoom=0.85)  # pyright: ignore[reportArgumentType]  # a float, says its documentation
    elevation, azimuth = _VIEWS[plane]
    axes.view_init(elev=elevation, azim=azimuth)
    axes.tick_params(labelsize=7, pad=0)


def _deflection_text(run: Run) -> str:
    deflection = largest_deflection(run)
    if not math.isfinite(deflection):
        return "not assembled"
    return f"largest deflection {1e3 * deflection:.3g} mm"


def assembly_figure(study: Study, runs: Mapping[str, Run], places: Mapping[str, Seat] | None = None) -> Figure:
    """The assembled mechanism at the start, nominal and assembled, one panel per case.

    All panels have the same factor, which the title names. Of more than six cases those with the
    largest deflections are shown. `places`: seats of the joints, of the mechanism if left out.
    """
    if places is None:
        from rfem_jax.mechanics.statics.designs import model_of_study

        places = joint_seats(study.mechanism, model_of_study(study))
    deflections = {name: np.nan_to_num(largest_deflection(run)) for name, run in runs.items()}
    kept = sorted(deflections, key=lambda name: deflections[name], reverse=True)[:_MOST_PANELS]
    shown = {name: runs[name] for name in runs if name in kept}
    factor = exaggeration(shown)
    first = next(iter(shown.values()))
    size = mechanism_size({link: np.asarray(line) for link, line in first.motion.nominal_lines.items()})
    joints = [joint for joint in study.mechanism.joints if joint.name in places]
    guides = {joint.name: guide_ends(joint, places[joint.name], shown, size) for joint in joints}
    low, high = _limits(shown, factor, guides)
    columns = 2 if len(shown) == 4 else min(len(shown), 3)
    rows = -(-len(shown) // columns)
    width, height = max(3.9 * columns, 6.0), 3.9 * rows + 1.9
    figure = new_figure(width, height, layout=None)
    for index, (case, run) in enumerate(shown.items()):
        axes = figure.add_subplot(rows, columns, index + 1, projection="3d", facecolor="none")
        _draw_mechanism(axes, study.mechanism, run, factor, places, guides)
        _format_axes(axes, low, high, study.mechanism.plane)
        axes.set_title(f"{in_legend(case, status_of(run))}: {_deflection_text(run)}", y=1.0)
    _lay_out(figure, study.mechanism, height)
    heading = f"Assembled mechanism at the start, deflections exaggerated {factor:g} times"
    add_titles(figure, heading, study)
    return figure


def start_figure(study: Study, model: Model) -> Figure:
    """The perfect mechanism at its start, links undeformed, as its loops are closed: without a run."""
    from rfem_jax.mechanics.model.nominal_geometry import geometry_of, node_place, place

    geometry, mechanism = geometry_of(model), study.mechanism
    placed = place(geometry, np.asarray(model.start_joints))
    ends = placed.origin + np.asarray(model.length)[:, None] * placed.rotation[:, :, 0]
    lines = {name: np.stack([placed.origin[l], ends[l]]) for l, name in enumerate(model.link_names)}
    places, size = joint_seats(mechanism, model), mechanism_size(lines)
    guides = {joint.name: guide_ends(joint, places[joint.name], {}, size) for joint in mechanism.joints}
    figure = new_figure(6.0, 5.8, layout=None)
    axes = figure.add_subplot(1, 1, 1, projection="3d", facecolor="none")
    axes.computed_zorder = False
    colours = {link: CASE_COLOURS[(n + 1) % len(CASE_COLOURS)] for n, link in enumerate(lines)}
    for n, (link, line) in enumerate(lines.items()):
        axes.plot(*line.T, color=colours[link], linestyle=LINE_STYLES[n % len(LINE_STYLES)], linewidth=2.2, label=link)
    points = _draw_joints(axes, mechanism, (lines, lines), colours, places, guides)
    draw_forces(axes, mechanism, forces_at_start(model), size, lambda _link, _x, there: there)
    _write_names(axes, mechanism, points, lines)
    for point in mechanism.points:
        carried = (model.points or {})[point.name]
        rotation, origin = node_place(geometry, placed, carried.node)
        points[f"point {point.name}"] = origin + rotation @ np.asarray(carried.position)
        _draw_point(axes, point.name, points[f"point {point.name}"], lines[point.link], point.name not in places)
    _format_axes(axes, *_box([*lines.values(), *(point[None] for point in points.values())], guides), mechanism.plane)
    _lay_out(figure, mechanism, 5.8)
    add_titles(figure, "The mechanism at its start", study)
    return figure


def _draw_point(axes: Axes3D, name: str, point: Point, line: Line, named: bool) -> None:
    """A point whose path is followed, with a thin line from its link, and its name unless a joint there has it."""
    start, along = line[0], line[-1] - line[0]
    length = float(along @ along)
    foot = start + along * (np.clip((point - start) @ along / length, 0.0, 1.0) if length > 0.0 else 0.0)
    label = None if "point that is followed" in axes.get_legend_handles_labels()[1] else "point that is followed"
    axes.plot(*np.stack([foot, point], axis=1), color="#404040", linewidth=0.8, linestyle=":")
    axes.plot(*point[:, None], color="#404040", marker="x", markersize=7, linestyle="none", zorder=6, label=label)
    if named:
        axes.text(point[0], point[1], point[2], f"  {name}", fontsize=9, style="italic", zorder=6)


def _lay_out(figure: Figure, mechanism: Mechanism, height: float) -> None:
    """Place panels and legend by hand: the automatic layout knows neither labels nor legends of 3D axes."""
    below = 0.75 + _LEGEND_ROW * max(_add_legend(figure, mechanism), 4)
    height += below - 1.5
    figure.set_figheight(height)
    figure.legends[0].set_bbox_to_anchor((0.5, _LEGEND_FOOT / height))
    figure.subplots_adjust(
        left=0.02, right=0.93, bottom=below / height, top=1.0 - 0.9 / height, wspace=0.08, hspace=0.15
    )


def _add_legend(figure: Figure, mechanism: Mechanism) -> int:
    """Links, kinds of joints and forces below the panels, in lines that fit; the number of lines."""
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    handles += legend_handles(mechanism)
    labels += [handle.get_label() for handle in handles[len(labels) :]]
    columns = min(max(int(figure.get_figwidth() / (0.75 + 0.075 * max(map(len, labels)))), 1), len(labels))
    figure.legend(
        handles,
        labels,
        loc="lower center",
        ncols=columns,
        handlelength=4,
        fontsize=8.5,
    )
    return -(-len(labels) // columns)
