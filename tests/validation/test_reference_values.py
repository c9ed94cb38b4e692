"""The files of reference values: complete, readable, packaged; and the values are nowhere else."""

import tomllib
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from rfem_jax.validation.reference_values import read_reference

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "rfem_jax" / "validation" / "references"
NAMES = sorted(path.stem for path in FOLDER.glob("*.json"))


def leaves(values):
    """Numbers and words of nested tables and lists."""
    if isinstance(values, dict):
        values = list(values.values())
    return [leaf for entry in values for leaf in leaves(entry)] if isinstance(values, list) else [values]


@pytest.mark.parametrize("name", NAMES)
def test_every_quantity_has_values_a_unit_and_a_source(name):
    reference = read_reference(name)
    assert reference.title and reference.quantities
    for key, quantity in reference.quantities.items():
        assert quantity.unit and quantity.description and quantity.label and len(quantity.source) > 20, key
        found = [leaf for leaf in leaves(quantity.values) if leaf is not None]
        assert found and reference[key] is quantity.values
        if quantity.unit != "-":
            assert np.isfinite(found).all()


def test_a_quantity_may_have_its_own_source():
    reference = read_reference("tilted_hinge")
    assert reference.quantities["rms_force"].label == reference.label
    assert "mb_sef_py" in reference.quantities["trajectory"].label != reference.label


def test_files_are_packaged():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packaged = content["tool"]["setuptools"]["package-data"]["rfem_jax"]
    found = {path for pattern in packaged for path in (ROOT / "rfem_jax").glob(pattern)}
    assert set(FOLDER.iterdir()) <= found


@pytest.mark.slow
def test_no_program_repeats_a_table():
    """Looks for numbers of six digits or more; one or two of them may be examples."""
    numbers = {leaf for name in NAMES for q in read_reference(name).quantities.values() for leaf in leaves(q.values)}
    written = {
        repr(x) for x in numbers if isinstance(x, float) and len(Decimal(repr(x)).normalize().as_tuple().digits) > 5
    }
    assert len(written) > 30
    programs = [
        path for folder in ("rfem_jax", "tests", "benchmarks", "studies") for path in (ROOT / folder).rglob("*.py")
    ]
    for path in programs:
        text = path.read_text(encoding="utf-8")
        assert len([number for number in written if number in text]) < 3, path
