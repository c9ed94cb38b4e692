"""`rfem-jax check --converge`."""

import json
from pathlib import Path

import pytest

from rfem_jax.report.command_line import main

pytestmark = pytest.mark.usefixtures("commands_here")
FOUR_BAR = Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml"
STUDY = """
title = "A bracket"
metrics = ["P.z"]
[mechanism]
gravity = [0, 0, 0]
[mechanism.sections.bar]
shape = "rectangle"
width = "20 mm"
height = "20 mm"
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850
[[mechanism.links]]
name = "beam"
length = "0.8 m"
section = "bar"
material = "steel"
[[mechanism.joints]]
name = "A"
parent = "base"
child = "beam"
kind = "fixed"
[[mechanism.points]]
name = "P"
link = "beam"
position = "0.8 m"
[[mechanism.forces]]
name = "push"
link = "beam"
position = "0.8 m"
force = [0, 0, "3 N"]
[statics]
[[cases]]
name = "as_drawn"
"""


def test_the_command(tmp_path, capsys):
    file = tmp_path / "study.toml"
    file.write_text(STUDY)
    assert main(["check", str(file), "--converge", "2 %", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["convergence"]
    assert document["rfes"] == {"beam": 5} and document["accuracy"] == 0.02 and document["wanted_rfes"] == {"beam": 5}
    assert main(["check", str(file), "--converge"]) == 0
    printed = capsys.readouterr().out
    assert "error of 5" in printed and "For 1 %: beam 6" in printed
    assert main(["check", str(file), "--converge", "often"]) == 2
    assert "`--converge` must be an accuracy" in capsys.readouterr().err
    assert main(["check", "--converge", str(file)]) == 2
    assert f"write the study first: rfem-jax check {file} --converge" in capsys.readouterr().err


@pytest.mark.long
def test_the_loads_of_a_simulation(tmp_path, capsys):
    """Of the main study over 50 ms: 5 rfes carry a few percent, as docs/theory/11_accuracy.md says."""
    text = FOUR_BAR.read_text(encoding="utf-8")
    text = text[: text.index("[[cases]]")] + '[[cases]]\nname = "P2"\nerrors = { "D.delta_x" = "0.5 deg" }\n'
    file = tmp_path / "study.toml"
    file.write_text(text.replace("duration = 0.5", 'duration = "50 ms"'))
    assert main(["check", str(file), "--converge", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["convergence"]
    rows = {row["metric"]: row for row in document["metrics"]}
    assert 0.01 < rows["D.rms_force"]["error"] < 0.05 and rows["D.rms_force"]["settled"]
    assert 8 <= document["wanted_rfes"]["coupler"] <= 16
