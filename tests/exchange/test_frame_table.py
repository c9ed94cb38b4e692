"""Tables of frames: written from studies and read back; written by hand, in other units, wrong."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from rfem_jax import InputError, describe, discretise, load_study
from rfem_jax.exchange.frame_table import COLUMNS, read_table, table_text
from rfem_jax.exchange.laying import finished
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text
from rfem_jax.report.command_line import main

from .machines import MACHINES, MOBILITY, same_places, study


def as_study(layout, folder):
    path = folder / "again.toml"
    path.write_text(study_text(layout, "a test", path.name), encoding="utf-8")
    return load_study(path)


@pytest.fixture(scope="module", params=MACHINES)
def machine(request):
    """Name of a machine, its layout, its table."""
    layout = layout_of(study(request.param))
    return request.param, layout, table_text(layout, request.param)[0]


@pytest.mark.parametrize("framed", [True, False])
def test_round_trip(machine, framed, tmp_path):
    """Frames of links are kept; laid anew they are elsewhere, but the mechanism is the same."""
    name, layout, text = machine
    again = as_study(finished(replace(read_table(text, name), framed=framed)), tmp_path)
    found = describe(discretise(again.mechanism))
    assert found.rigid_mobility == MOBILITY[name] and found.gap < 1e-9
    second = layout_of(again)
    assert same_places(layout, second)
    if framed:
        for body in layout.bodies:
            other = second.body(body.name)
            np.testing.assert_allclose(other.pose.rotation, body.pose.rotation, atol=1e-9)
            np.testing.assert_allclose(other.pose.position, body.pose.position, atol=1e-9)
            np.testing.assert_allclose(other.length, body.length)
        for joint, other in zip(layout.joints, second.joints, strict=True):
            np.testing.assert_allclose(other.seat.rotation, joint.seat.rotation, atol=1e-9)
            np.testing.assert_allclose(other.bore.rotation, joint.bore.rotation, atol=1e-9)


def test_planar_links_are_laid_as_one_would_write_them(tmp_path):
    """Without frames of links: x from joint to joint, no orientations, angles between links."""
    layout = layout_of(study("four_bar"))
    table = read_table(table_text(layout, "four-bar")[0], "x")
    mechanism = as_study(finished(replace(table, framed=False)), tmp_path).mechanism
    for joint, first in zip(mechanism.joints, MACHINES["four_bar"]().joints, strict=True):
        assert joint.orientation == joint.child_orientation == (0.0, 0.0, 0.0)
        assert joint.position in (None, (0.3, 0.0, 0.0)) and joint.child_position is None
        if not joint.cut:
            assert joint.angle == pytest.approx(first.angle, abs=1e-6)
    assert [link.length for link in mechanism.links] == pytest.approx([0.12, 0.3, 0.3])


def test_errors_are_in_the_frames(tmp_path):
    """A seat 1 mm higher: the loop is closed elsewhere, the table has the joint's two places where they are."""
    from rfem_jax import Case

    errors = {"D.d_x": "1 mm", "coupler.length": "0.5 mm"}
    shifted = layout_of(study("four_bar", cases=(Case("shifted", errors),)), "shifted")
    assert shifted.remarks == ()
    left, _ = shifted.sides(shifted.joints[2])
    np.testing.assert_allclose(left.position, [0.301, 0.0, 0.0], atol=1e-12)
    c, d = shifted.sides(shifted.joints[3])
    np.testing.assert_allclose(c.position, d.position, atol=1e-9)
    b = shifted.sides(shifted.joints[1])[0].position
    assert np.linalg.norm(c.position - b) == pytest.approx(0.3005, abs=1e-9)
    assert shifted.body("coupler").mass == pytest.approx(0.2355)
    again = layout_of(as_study(finished(read_table(table_text(shifted, "x")[0], "x")), tmp_path))
    assert same_places(shifted, again)


def test_an_open_loop_is_told():
    from rfem_jax import Case

    tilted = layout_of(study("four_bar", cases=(Case("tilted", {"D.delta_x": "1 deg"}),)), "tilted")
    assert "the loops stay open by 0.00" in tilted.remarks[0]


COLUMNS_BY_HAND = (
    "name;kind;parent;child;x_mm;y_mm;z_mm;axis_x;axis_y;axis_z;mass_g;centre_x_mm;centre_y_mm;centre_z_mm;"
    "xx_gmm2;yy_gmm2;zz_gmm2"
)
BY_HAND = f"""{COLUMNS_BY_HAND}
arm;body;;;;;;;;;500;50;0;0;0;1e6;1e6
A;hinge;base;arm;0;0;0;0;2;0;;;;;;;
"""


def test_by_hand(tmp_path, capsys):
    """Few columns, other units, semicolons; the moments about the other axes are those of no body."""
    path = tmp_path / "arm.csv"
    path.write_text(BY_HAND, encoding="utf-8")
    assert main(["import", str(path), "-o", str(tmp_path / "arm.toml"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["links"] == ["arm"] and document["joints"] == ["A"]
    assert len(document["remarks"]) == 1 and "principal moment of zero" in document["remarks"][0]
    (link,) = load_study(tmp_path / "arm.toml").mechanism.links
    assert link.mass == pytest.approx(0.5) and link.length == pytest.approx(0.1)
    assert link.body.centre == pytest.approx((0.05, 0.0, 0.0))
    assert link.body.tensor[1, 1] == pytest.approx(1e-3, rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("hinge", "hinges", "must be a kind of joint"),
        ("base", "bass", "must be a body of the table or base"),
        ("0;2;0", "0;0;0", "must be a direction, but is zero"),
        ("0;2;0", ";;", "must have the axis of joint"),
        ("500", "", "must have the mass"),
        ("500", "-500", "must be at least 0"),
        ("50;0;0", "50;0;", "lacks one"),
        ("mass_g", "mass_lb", "must end with its unit"),
        ("mass_g", "weight", "must be those that"),
        ("yy_gmm2", "yy", "must end with its unit"),
        ("name;kind", "name;name", "twice"),
        ("A;hinge", "base;hinge", "a name other than base"),
        ("0;2;0;", "0;2;0;;;;;;;;", "at most"),
        ("1e6", "1e6x", "must be a finite number"),
        ("1e6", "inf", "must be a finite number"),
        ("arm;body", "arm;gravity", "axis_x"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(old, new, says):
    assert old in BY_HAND
    with pytest.raises(InputError, match=says) as found:
        finished(read_table(BY_HAND.replace(old, new, 1), "x"))
    assert len(found.value.problems) == 1


def test_the_command(tmp_path, capsys):
    path, table = tmp_path / "mine.toml", tmp_path / "mine.csv"
    assert main(["init", str(path), "--kind", "slider-crank"]) == 0
    capsys.readouterr()
    assert main(["export", str(path), "--to", "frames", "--case", "guide_tilted", "-o", str(table)]) == 0
    said = capsys.readouterr().out
    assert "case guide_tilted" in said and "flexibility of rod" in said and "The drive of A" in said
    text = table.read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO("".join(line for line in text.splitlines(True) if line[0] != "#"))))
    assert tuple(rows[0]) == COLUMNS and [row["name"] for row in rows[-4:]] == ["A", "B", "G", "P"]
    assert main(["export", str(path), "--to", "frames", "-o", str(table)]) == 2
    assert "exists; choose another name" in capsys.readouterr().err
    assert main(["export", str(path), "--to", "frames", "--case", "guide", "-o", str(tmp_path / "x")]) == 2
    assert "must be a case of the study" in capsys.readouterr().err
    assert main(["import", str(tmp_path / "none.csv"), "-o", str(tmp_path / "y.toml")]) == 2
    assert "there is none" in capsys.readouterr().err
