"""Four machines as files that the package has not written, in MJCF and SDF each (files/README.md): masses, places and
mobility are equal, and what is imported moves as MuJoCo moves the file itself."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from rfem_jax import RungeKutta4, describe, discretise, load_study
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.layout import BASE
from rfem_jax.exchange.mujoco_motion import compared, rigid_study
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text

from .machines import MOBILITY, centre_of, inertia_of
from .test_mjcf import needs_mujoco

FILES = Path(__file__).parent / "files"


def imported(path, folder):
    """The layout of a file, and the study that is written of it."""
    layout, kind = read_layout(path)
    toml = folder / f"{path.stem}_{kind}.toml"
    toml.write_text(study_text(layout, path.name, toml.name), encoding="utf-8")
    return layout, load_study(toml)


def numbers_of(name):
    """What the file in SDF says, read here: {link: (mass, centre, tensor)}, {joint: (place, axes)}."""
    root = Xml.parse(FILES / f"{name}.sdf").getroot()

    def row(text):
        return np.array([float(word) for word in text.split()])

    links = {}
    for link in root.iter("link"):
        tensor = np.zeros((3, 3))
        for i in range(3):
            for j in range(i, 3):
                tensor[i, j] = tensor[j, i] = float(link.findtext(f"inertial/inertia/i{'xyz'[i]}{'xyz'[j]}"))
        links[link.get("name")] = float(link.findtext("inertial/mass")), row(link.findtext("pose"))[:3], tensor
    joints = {}
    for joint in root.iter("joint"):
        axes = [row(axis.text) for axis in joint.iter("xyz")]
        joints[joint.get("name")] = row(joint.findtext("pose"))[:3], axes
    return links, joints


def check(name, layout, study):
    links, joints = numbers_of(name)
    assert {body.name for body in layout.bodies} == set(links)
    found = describe(discretise(study.mechanism))
    assert found.rigid_mobility == MOBILITY[name] and found.gap < 1e-7
    again = layout_of(study)
    for body in again.bodies:
        mass, centre, tensor = links[body.name]
        assert body.mass == pytest.approx(mass)
        np.testing.assert_allclose(centre_of(body), centre, atol=1e-8)
        np.testing.assert_allclose(inertia_of(body), tensor, atol=1e-9)  # digits of the MJCF
    for joint in again.joints:
        if joint.name not in joints:  # that of the platform to the base, which SDF does not need
            assert joint.kind == "free" and joint.parent == BASE
            continue
        place, axes = joints[joint.name]
        left, right = again.sides(joint)
        across = axes[0] if joint.kind == "prismatic" else np.zeros(3)
        for side in (left, right):
            apart = side.position - place
            np.testing.assert_allclose(apart - (apart @ across) * across, 0.0, atol=1e-7)
        if joint.kind in ("revolute", "prismatic"):
            along = 0 if joint.kind == "prismatic" else 1
            assert abs(left.rotation[:, along] @ axes[0]) == pytest.approx(1.0, abs=1e-9)
        if joint.kind == "universal":  # from below or from above
            two = left.rotation[:, 1], right.rotation[:, 2]
            assert sorted(abs(one @ axis) for one in two for axis in axes)[2:] == pytest.approx([1.0, 1.0], abs=1e-7)


@pytest.mark.parametrize("name", MOBILITY)
def test_sdf(name, tmp_path):
    layout, study = imported(FILES / f"{name}.sdf", tmp_path)
    assert layout.remarks == ()
    check(name, layout, study)


@needs_mujoco
@pytest.mark.parametrize("name", MOBILITY)
def test_mjcf(name, tmp_path):
    layout, study = imported(FILES / f"{name}.xml", tmp_path)
    check(name, layout, study)


@needs_mujoco
@pytest.mark.slow
@pytest.mark.parametrize("name", MOBILITY)
def test_what_is_imported_moves_as_the_file(name, tmp_path):
    """MuJoCo runs the file that was imported, not one of ours."""
    _, study = imported(FILES / f"{name}.xml", tmp_path)
    layout = layout_of(study)
    rigid = replace(rigid_study(study, None, layout), method=RungeKutta4(step=5e-4))
    starts = {joint.name: joint.start for joint in layout.joints}
    found = compared((FILES / f"{name}.xml").read_text(encoding="utf-8"), rigid, layout)
    # The file counts from its own zero, where it stands; angles of the study are those between links.
    shifted = {joint: values + starts[joint][0] for joint, values in found.theirs.items()}
    found = replace(found, theirs=shifted)
    assert max(np.ptp(values) for values in found.ours.values()) > 1e-2
    assert found.largest() < found.tolerance
