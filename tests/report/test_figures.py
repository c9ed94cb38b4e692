"""Pictures: all are there, none is blank, and they show the numbers they should."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import label

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.path import Path

from rfem_jax import STATUS, Compliance, Joint, load_study
from rfem_jax.report.contents.summary import summarise
from rfem_jax.report.drawings import shapes
from rfem_jax.report.drawings.figures import component_figure, draw_figures, shown_joints, write_figures
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.shapes import (
    assembly_figure,
    exaggerated_lines,
    exaggeration,
    joint_point,
    point_on_line,
    round_factor,
    seats,
)
from rfem_jax.report.drawings.style import SETTINGS, bar_style, line_style
from rfem_jax.simulation.outcome.quantities import RMS_MOMENT

from .conftest import STUDY, all_complete, synthetic_runs

NAMES = {
    *("angle", "rate", "angle_D", "energy", "maximum_forces", "rms_loads", "preload"),
    *("base_joint_force", "base_joint_moment", "joint_D_force", "joint_D_moment"),
    *("joint_C_force", "joint_C_moment", "assembly"),
}


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    """The pictures of the fixtures `study`, `runs` and `statuses`, drawn once for the tests that only look at them."""
    path = tmp_path_factory.mktemp("figures") / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    study, runs = load_study(path), synthetic_runs()
    return draw_figures(study, runs, summarise(study, runs, all_complete()))


@pytest.fixture
def _coarse(monkeypatch):
    """Few pixels and no search for a layout, for tests of whether pictures are drawn at all."""
    monkeypatch.setitem(SETTINGS, "savefig.dpi", 30)
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)


@pytest.mark.long
@pytest.mark.usefixtures("_coarse")
def test_a_case_that_failed_is_marked_in_every_picture(study, runs, statuses):
    statuses["P2"] = ("diverged", "The run diverged; reduce the step.")
    code = next(number for number, one in enumerate(STATUS) if one.name == "diverged")
    runs = runs | {"P2": SimpleNamespace(**vars(runs["P2"]) | {"status": np.asarray(code)})}
    figures = draw_figures(study, runs, summarise(study, runs, statuses))
    for name, figure in figures.items():
        assert "P2* (diverged)" in texts(figure), name
        assert "P1*" not in texts(figure) and "P3*" not in texts(figure), name


def texts(figure):
    """All words of a figure: titles, axis names, legends and captions."""
    return " ".join(item.get_text() for item in figure.findobj(matplotlib.text.Text))


def bars(figure, panel):
    """Heights of the bars of one panel, {case: one per joint}."""
    axes = figure.axes[panel]
    return {one.get_label(): [bar.get_height() for bar in one] for one in axes.containers}


@pytest.mark.long
def test_all_pictures_are_written_and_none_is_blank(tmp_path, study, runs, statuses):
    paths = write_figures(tmp_path, study, runs, summarise(study, runs, statuses))
    assert {path.stem for path in paths} == NAMES
    for path in paths:
        picture = imread(path)[..., :3]
        assert picture.shape[1] >= 1000, path
        dark = (picture < 0.9).any(axis=2)
        assert 0.005 < dark.mean() < 0.6, path
        assert label(dark)[1] > 50, path
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.slow
def test_every_picture_has_a_title_and_units(figures):
    for name, unit in (
        ("angle", "angle, rad"),
        ("rate", "rate, rad/s"),
        ("energy", "energy, J"),
        ("maximum_forces", "force, N"),
        ("rms_loads", "moment, N m"),
        ("preload", "moment, N m"),
        ("base_joint_force", "force, N"),
        ("joint_D_moment", "moment, N m"),
        ("assembly", "Z, m"),
    ):
        words = texts(figures[name])
        assert "Test four-bar" in words, name
        assert unit in words, name


def test_the_note_is_the_caption_of_every_picture(study, runs, statuses):
    object.__setattr__(study, "note", "Substitute data.")
    for name, figure in draw_figures(study, runs, summarise(study, runs, statuses)).items():
        assert "Substitute data." in texts(figure), name


@pytest.mark.long
@pytest.mark.usefixtures("_coarse")
def test_a_dollar_in_the_title_is_a_dollar(tmp_path, study, runs, statuses):
    priced = replace(study, title=r"Costs $5, not $\alpha_{", note="$ and $")
    written = write_figures(tmp_path, priced, runs, summarise(priced, runs, statuses))
    assert len(written) == len(list(tmp_path.glob("*.png")))


def test_curves_and_their_differences(figures, runs):
    upper, lower = figures["angle"].axes
    curves = {line.get_label(): line.get_ydata() for line in upper.lines}
    np.testing.assert_array_equal(curves["P2"], runs["P2"].motion.angle)
    np.testing.assert_allclose(lower.lines[0].get_ydata(), 0.02 * runs["P2"].times, atol=1e-14)
    assert "from P1" in lower.get_ylabel()


def test_the_motion_that_comes_out_is_drawn(figures, runs):
    upper, lower = figures["angle_D"].axes
    np.testing.assert_array_equal(upper.lines[2].get_ydata(), 0.1 * runs["P3"].times)
    np.testing.assert_allclose(lower.lines[1].get_ydata(), 0.1 * runs["P3"].times)
    assert "Angle of joint D (rocker)" in texts(figures["angle_D"])


def test_bars_show_the_metrics_and_resultants(figures):
    assert bars(figures["rms_loads"], 0)["P2"] == [2.0, 4.0, 6.0, 8.0]
    assert bars(figures["rms_loads"], 1)["P3"] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert bars(figures["maximum_forces"], 0)["P2"] == [4.0, 8.0, 12.0, 16.0]
    assert bars(figures["maximum_forces"], 1)["P2"] == [6.0, 12.0, 18.0, 24.0]
    resultant = np.linalg.norm([2.0, 4.0, 6.0])
    assert bars(figures["preload"], 0)["P2"][0] == pytest.approx(resultant)


def test_force_components_without_and_with_errors(figures, runs):
    panels = figures["base_joint_force"].axes
    assert [line.get_label().split(",")[0] for line in panels[0].lines] == ["P1", "P2", "P3"]
    np.testing.assert_array_equal(panels[1].lines[1].get_ydata(), runs["P2"].loads["A"].force[:, 1])


def test_joints_of_the_base_and_the_most_loaded_ones_have_their_pictures(figures, study, runs, statuses):
    curves = figures["joint_C_moment"].axes[2].lines
    np.testing.assert_array_equal(curves[1].get_ydata(), runs["P2"].loads["C"].moment[:, 2])
    assert "Moment in joint C" in texts(figures["joint_C_moment"])
    assert "about y, the hinge" in texts(figures["joint_D_moment"])
    runs["P2"].loads["A"].moment[:, 1] = 1e-7  # what Newton's method leaves of a moment that a hinge cannot have
    rounded = component_figure(study, runs, summarise(study, runs, statuses), "A", RMS_MOMENT).axes[1].lines[1]
    np.testing.assert_array_equal(rounded.get_ydata(), 0.0)
    summaries = summarise(study, runs, statuses)
    assert shown_joints(study, summaries) == ["A", "D", "C"]
    summaries["P3"]["joints"]["B"]["rms_moment"] = 100.0  # of one case is enough
    summaries["P1"]["joints"]["B"]["rms_force"] = float("nan")
    assert shown_joints(study, summaries) == ["A", "D", "C", "B"]


@pytest.mark.long
@pytest.mark.usefixtures("_coarse")
def test_a_failed_case_is_marked_and_does_not_break_pictures(tmp_path, study, runs, statuses):
    run = runs["P2"]
    run.motion.angle[3:] = np.nan
    for values in vars(run.metrics).values():
        values.update(dict.fromkeys(values, float("nan")))
    for joint in run.preload:
        run.preload[joint].force[:] = np.nan
        run.preload[joint].moment[:] = np.nan
        run.loads[joint].force[3:] = np.nan
    run.motion.centre_lines = {link: line * np.nan for link, line in run.motion.centre_lines.items()}
    figures = draw_figures(study, runs, summarise(study, runs, statuses))
    assert texts(figures["rms_loads"]).count("n/a") == 8
    assert "not assembled" in texts(figures["assembly"])
    assert {path.stem for path in write_pictures(tmp_path, figures)} == NAMES


def test_a_single_case_without_a_drive(study, runs, statuses):
    object.__setattr__(study, "drive", None)
    object.__setattr__(study, "cases", study.cases[:1])
    runs = {"P1": runs["P1"]}
    figures = draw_figures(study, runs, summarise(study, runs, statuses))
    # The loads of this run are zero: no joint is loaded most.
    assert set(figures) == NAMES - {"angle", "rate", "joint_C_force", "joint_C_moment"} | {"angle_A"}
    assert len(figures["energy"].axes) == 1


def test_the_exaggeration_factor(runs):
    assert [round_factor(value) for value in (0.3, 1.0, 1.99, 5.0, 49.0, 50.0, 730.0)] == [
        *(1.0, 1.0, 1.0, 5.0, 20.0, 50.0, 500.0)
    ]
    factor = exaggeration(runs)
    # 2 mm of deflection and a mechanism of 0.42 m: a fifth of it is 42 times the deflection.
    assert factor == 20.0
    lines = exaggerated_lines(runs["P2"], factor)
    np.testing.assert_allclose(lines["rocker"][-1], [0.244, 0.04, 0.295])
    assert exaggeration({"P1": runs["P1"]}) == 1.0


NODES = np.array([0.0, 0.075, 0.15, 0.225, 0.28125, 0.3])  # middles of five rfes: not equally spaced


def test_points_of_a_line_are_found_by_their_distance_from_its_origin():
    straight = np.outer(NODES, [0.0, 0.6, 0.8])
    bent = straight + np.outer(NODES**2, [1.0, 0.0, 0.0])
    for x in (0.0, 0.15, 0.28125, 0.3):
        np.testing.assert_allclose(point_on_line(bent, straight, x), [x**2, 0.6 * x, 0.8 * x], atol=1e-15)
    np.testing.assert_allclose(point_on_line(straight, straight, 0.26), 0.26 * np.array([0.0, 0.6, 0.8]))
    # Beyond the ends of a rigid link.
    np.testing.assert_allclose(point_on_line(straight, straight, 0.4), [0.0, 0.24, 0.32])
    np.testing.assert_allclose(point_on_line(straight, straight, -0.1), [0.0, -0.06, -0.08])


@pytest.fixture
def ternary(study):
    """A coupler with a third joint, 60 mm off its axis, at which the strut ends; its lines."""
    strut = replace(study.mechanism.links[2], name="strut", length=0.2)
    third = Joint("E", "strut", "coupler", child_position=(0.17, 0.0, 0.06), cut=True)
    joints = (*study.mechanism.joints, Joint("F", "base", "strut", position=(0.0, 0.0, 0.42)), third)
    mechanism = replace(study.mechanism, links=(*study.mechanism.links, strut), joints=joints)
    lines = {
        "crank": np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.12]]),
        "coupler": np.array([0.0, 0.0, 0.12]) + np.outer(NODES, [1.0, 0.0, 0.0]),
        "rocker": np.array([0.3, 0.0, 0.0]) + np.outer(NODES, [0.0, 0.0, 0.4]),
        "strut": np.array([0.17, 0.0, 0.38]) + np.outer(NODES / 1.5, [0.0, 0.0, -1.0]),
    }
    return mechanism, lines


def test_a_joint_off_the_axis_of_its_link_is_drawn_where_the_other_link_ends(ternary):
    mechanism, lines = ternary
    np.testing.assert_allclose(joint_point(mechanism, mechanism.joint("E"), lines, lines), [0.17, 0.0, 0.18])
    np.testing.assert_allclose(joint_point(mechanism, mechanism.joint("B"), lines, lines), [0.0, 0.0, 0.12])
    (child, seat), (parent, end) = seats(mechanism, mechanism.joint("E"))
    assert (
        (child, parent) == ("coupler", "strut") and tuple(seat) == (0.17, 0.0, 0.06) and tuple(end) == (0.2, 0.0, 0.0)
    )
    # A joint in the middle of a link, on its axis, is on its line.
    on_axis = replace(mechanism.joint("E"), child_position=(0.17, 0.0, 0.0))
    np.testing.assert_allclose(joint_point(mechanism, on_axis, lines, lines), [0.17, 0.0, 0.12])
    # Off both axes: between them.
    off_both = replace(mechanism.joint("E"), position=(0.1, 0.0, 0.02))
    np.testing.assert_allclose(joint_point(mechanism, off_both, lines, lines), [0.17, 0.0, 0.2])


def test_an_arm_joins_the_axis_and_the_joint(ternary, study, runs):
    mechanism, lines = ternary
    motion = SimpleNamespace(**vars(runs["P1"].motion) | {"centre_lines": lines, "nominal_lines": lines})
    run = SimpleNamespace(**vars(runs["P1"]) | {"motion": motion})
    # This mechanism does not close: no places of its joints.
    figure = assembly_figure(replace(study, mechanism=mechanism, cases=study.cases[:1]), {"P1": run}, {})
    arms = [np.stack(line.get_data_3d(), axis=1) for line in figure.axes[0].lines if line.get_linewidth() == 1.2]
    arms = [arm for arm in arms if len(arm) == 2 and np.ptp(arm[:, 2]) > 0.05]
    assert any(np.allclose(arm, [[0.17, 0.0, 0.12], [0.17, 0.0, 0.18]]) for arm in arms)


def test_a_compliant_joint_is_marked_by_a_coil(study, runs):
    joints = [replace(j, compliance=Compliance(radial=1e8) if j.name in "BC" else None) for j in study.mechanism.joints]
    made = replace(study, mechanism=replace(study.mechanism, joints=joints))
    drawn = assembly_figure(made, {"P2": runs["P2"]}).axes[0].lines
    paths = [line for line in drawn if isinstance(line.get_marker(), Path) and len(line.get_marker().vertices) == 9]
    coils = [np.stack(line.get_data_3d(), axis=1)[0] for line in paths]
    np.testing.assert_allclose([coil[[0, 2]] for coil in coils], [[0.0, 0.12], [0.244, 0.295]], atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("symbols", [0, 9])
def test_no_label_of_the_assembly_is_clipped(study, runs, symbols, monkeypatch):
    """Labels of axes and legend are inside of the picture and apart from each other, for any number of cases, links and
    kinds of joints."""
    if symbols:
        handles = [Line2D([], [], label=f"symbol {n}") for n in range(symbols)]
        monkeypatch.setattr(shapes, "legend_handles", lambda mechanism: handles)
    for count in (1, 2, 3, 4):
        few = {f"P{number}": runs["P2"] for number in range(count)}
        figure = assembly_figure(study, few)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        boxes = [figure.legends[0].get_window_extent()]
        for axes in figure.axes:
            for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
                boxes.append(axis.label.get_window_extent())
        width, height = canvas.get_width_height()
        for box in boxes:
            assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
        assert not any(boxes[0].overlaps(box) for box in boxes[1:])


def test_the_title_names_the_factor(figures):
    assert "deflections exaggerated 20 times" in texts(figures["assembly"])


def test_cases_differ_by_more_than_colour():
    lines = [line_style(index, 100) for index in range(20)]
    assert len({(str(one["linestyle"]), one["marker"]) for one in lines}) == 20
    hatches = [(bar_style(index)["hatch"], bar_style(index)["color"]) for index in range(20)]
    assert len(set(hatches)) == 20


def test_global_settings_of_matplotlib_stay(figures):
    assert matplotlib.rcParams["savefig.dpi"] == matplotlib.rcParamsDefault["savefig.dpi"]


@pytest.mark.slow
def test_a_written_picture_is_what_matplotlib_saves(tmp_path, study, runs, statuses):
    """With the automatic layout and without; pixel by pixel."""
    one, other = (draw_figures(study, runs, summarise(study, runs, statuses)) for _ in range(2))
    for name in ("rate", "assembly"):
        (path,) = write_pictures(tmp_path, {name: one[name]})
        with matplotlib.rc_context(SETTINGS):
            other[name].savefig(tmp_path / "saved.png")
        expected = imread(tmp_path / "saved.png")
        assert (expected[:, :, 3] == 1.0).all()
        np.testing.assert_array_equal(imread(path), expected[:, :, :3])
