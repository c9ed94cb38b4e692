"""Start values that a description leaves out: a mode or a rough value chooses how loops close."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rfem_jax import InputError, Joint, Mechanism, assemble, design, discretise
from rfem_jax.report.contents.overview import closed_text
from tests.mechanics.test_redundant_reactions import plain

BASE, CRANK, COUPLER, ROCKER = 0.3, 0.12, 0.3, 0.25


def four_bar(crank=-np.pi / 2, mode=None, cut="C", base=BASE, **given):
    """Only the driven joint has its start value; `given`: of others."""
    links = [plain("crank", CRANK), plain("coupler", COUPLER), plain("rocker", ROCKER)]
    ways = {
        "C": [("B", "crank", "coupler"), ("D", "base", "rocker"), ("C", "coupler", "rocker")],
        "D": [("B", "crank", "coupler"), ("C", "coupler", "rocker"), ("D", "base", "rocker")],
        "B": [("D", "base", "rocker"), ("C", "rocker", "coupler"), ("B", "crank", "coupler")],
    }[cut]
    joints = [Joint("A", "base", "crank", angle=crank)]
    for name, parent, child in ways:
        ends = {"position": (base, 0.0, 0.0)} if name == "D" else {}
        ends |= {"child_position": (0.0, 0.0, 0.0)} if name == "B" or (name, cut) == ("D", "D") else {}
        more = {"cut": True, "mode": mode} if name == cut else {"angle": given.get(name)}
        if (name, cut) == ("D", "D"):
            ends["child_position"] = (ROCKER, 0.0, 0.0)  # the rocker runs from C to D
        if (name, cut) == ("B", "B"):
            ends["child_position"] = (COUPLER, 0.0, 0.0)  # the coupler runs from C to B
        joints.append(Joint(name, parent, child, **ends, **more))
    return Mechanism(links, joints, driven_joint="A")


def ways(crank, base=BASE):
    """Places of C by circles about B and D, (x, z) each; the first is open, with A and C on either side of BD."""
    b = CRANK * np.array([np.cos(crank), -np.sin(crank)])
    d = np.array([base, 0.0])
    apart = np.linalg.norm(d - b)
    along, across = (d - b) / apart, np.array([-(d - b)[1], (d - b)[0]]) / apart
    foot = (COUPLER**2 - ROCKER**2 + apart**2) / (2.0 * apart)
    height = np.sqrt(COUPLER**2 - foot**2)
    side = np.sign(across @ -b)  # of A
    return [b + foot * along - side * height * across, b + foot * along + side * height * across]


def angle_of(vector):
    return np.arctan2(-vector[1], vector[0])  # about y, from x to -z


def angle_b(crank, place):
    b = CRANK * np.array([np.cos(crank), -np.sin(crank)])
    return angle_of(place - b) - crank


def found_b(mechanism):
    model = discretise(mechanism)
    return float(model.start_joints[model.topology.joints.index("B")])


def same(one, other):
    return abs(np.arctan2(np.sin(one - other), np.cos(one - other))) < 1e-9


@pytest.mark.parametrize("crank", [-np.pi / 2, 0.7, 2.5, -2.0])
@pytest.mark.parametrize(("mode", "way"), [("open", 0), ("crossed", 1)])
def test_modes_of_a_four_bar(crank, mode, way):
    expected = angle_b(crank, ways(crank)[way])
    assert same(found_b(four_bar(crank, mode)), expected)
    assert same(found_b(four_bar(crank, mode, "D")), expected)


def test_modes_wherever_the_loop_is_cut():
    for mode, way in (("open", 0), ("crossed", 1)):
        model = discretise(four_bar(0.7, mode, "B"))
        d = float(model.start_joints[model.topology.joints.index("D")])
        assert same(d, angle_of(ways(0.7)[way] - np.array([BASE, 0.0])))


def test_a_mode_overrides_start_values():
    for mode, way in (("open", 0), ("crossed", 1)):
        for rough in ways(0.7):
            mechanism = four_bar(0.7, mode, B=angle_b(0.7, rough), D=0.1)
            assert same(found_b(mechanism), angle_b(0.7, ways(0.7)[way]))


def unfriendly(**more):
    """Where closing the loop fails from zeros."""
    return four_bar(np.pi, base=0.36, **more)


def test_without_a_choice_both_ways_are_told():
    with pytest.raises(InputError) as refused:
        discretise(unfriendly())
    text = str(refused.value)
    assert "in 2 ways" in text and "(C open)" in text and "(C crossed)" in text
    assert 'mode = "open" or "crossed" of joint `C`' in text


@pytest.mark.parametrize("way", [0, 1])
@pytest.mark.parametrize("joint", ["B", "D"])
def test_a_rough_value_of_one_joint_chooses(joint, way):
    place = ways(np.pi, 0.36)[way]
    angles = {"B": angle_b(np.pi, place), "D": angle_of(place - np.array([0.36, 0.0]))}
    rough = {joint: angles[joint] + 0.3}
    assert same(found_b(unfriendly(**rough)), angles["B"])


def slider_crank(mode=None, **more):
    links = [plain("crank", 0.1), plain("rod", 0.33), plain("slide", 0.1)]
    joints = [
        Joint("A", "base", "crank", angle=0.8),
        Joint("B", "crank", "rod"),
        Joint("G", "base", "slide", kind="prismatic", **more),
        Joint("P", "slide", "rod", position=(0, 0, 0), cut=True, mode=mode),
    ]
    return Mechanism(links, joints, driven_joint="A")


@pytest.mark.parametrize(("mode", "sign"), [("open", 1.0), ("crossed", -1.0)])
def test_modes_of_a_slider_crank(mode, sign):
    model = discretise(slider_crank(mode))
    expected = 0.1 * np.cos(0.8) + sign * np.sqrt(0.33**2 - (0.1 * np.sin(0.8)) ** 2)
    place = model.topology.place_of(model.topology.coordinates[model.topology.joints.index("G")][0])
    np.testing.assert_allclose(model.start_joints[place], expected, rtol=1e-9)


def test_spatial_loops_close_from_the_driven_joint():
    """A crank, a rod between two balls and a rocker about another axis: C lies on two circles."""
    links = [plain("crank", 0.1), plain("rod", 0.4), plain("rocker", 0.25)]
    joints = [
        Joint("A", "base", "crank", angle=0.4),
        Joint("B", "crank", "rod", kind="spherical"),
        Joint("D", "base", "rocker", position=(0.35, 0.1, 0.0), orientation=(np.pi / 2, 0.0, 0.0)),
        Joint("C", "rod", "rocker", kind="spherical", cut=True),
    ]
    mechanism = Mechanism(links, joints, driven_joint="A")
    for rough in (1.0, -1.0, 2.0):
        started = [replace(one, angle=rough) if one.name == "D" else one for one in joints]
        model = discretise(replace(mechanism, joints=started))
        angle = float(
            model.start_joints[model.topology.place_of(model.topology.coordinates[model.topology.joints.index("D")][0])]
        )
        c = np.array([0.35 + 0.25 * np.cos(angle), 0.1 + 0.25 * np.sin(angle), 0.0])
        b = 0.1 * np.array([np.cos(0.4), 0.0, -np.sin(0.4)])
        np.testing.assert_allclose(np.linalg.norm(c - b), 0.4, rtol=1e-9)


@pytest.mark.long
def test_designs_stay_in_the_mode():
    """The start is closed anew for another length, and has derivatives."""
    for mode, way in (("open", 0), ("crossed", 1)):
        model = discretise(four_bar(0.7, mode))

        def angle(base, model=model):
            found = assemble(model, design=design(model, {"D.position.x": base}))
            return found.state.position.joints[model.topology.joints.index("B")]

        for base in (0.3, 0.29):
            assert same(float(angle(base)), angle_b(0.7, ways(0.7, base)[way]))
        by_difference = (angle_b(0.7, ways(0.7, 0.3 + 1e-6)[way]) - angle_b(0.7, ways(0.7, 0.3 - 1e-6)[way])) / 2e-6
        np.testing.assert_allclose(jax.jit(jax.grad(angle))(0.3), by_difference, rtol=1e-6)


@pytest.mark.long
def test_what_cannot_be_is_told():
    with pytest.raises(InputError, match="joint 'C' stays open by .* other starts were tried"):
        discretise(four_bar(np.pi, base=0.6))
    with pytest.raises(InputError, match="as its modes say|stays open"):
        discretise(four_bar(np.pi, base=0.6, mode="open"))
    with pytest.raises(InputError, match='`mode` of joint `C` must be one of "open", "crossed"'):
        four_bar(mode="folded")
    with pytest.raises(InputError, match="`mode` of joint `A` must be left out because the joint is not cut"):
        Joint("A", "base", "crank", mode="open")
    with pytest.raises(InputError, match="`mode` of joint `P` must be left out unless .* a slide that no drive moves"):
        discretise(replace(slider_crank("open", displacement=0.39), driven_joint="G"))
    six = [plain(name, 0.1) for name in ("a", "b", "c", "d")]
    joints = [Joint("A", "base", "a", angle=0.5), Joint("B", "a", "b", angle=0.2), Joint("C", "b", "c", angle=0.3),
              Joint("E", "base", "d", position=(0.2, 0, 0), angle=-0.4),
              Joint("F", "c", "d", cut=True, mode="open")]  # fmt: skip
    with pytest.raises(InputError, match="`mode` of joint `F` must be left out unless its loop has four joints"):
        discretise(Mechanism(six, joints, driven_joint="A"))


def test_check_says_how_loops_are_closed():
    text = closed_text(discretise(four_bar(0.7, "crossed")))
    assert text.startswith("Loops are closed with A = 40.107 deg, B = ") and text.endswith("(C crossed).")
    assert "(" not in closed_text(discretise(slider_crank("crossed")))
