"""Tables of mechanisms and studies in notebooks: what they show, and that all text is escaped."""

import dataclasses

from rfem_jax import Case, MomentRamp, RungeKutta4, Study, rich_text

from ..mechanisms import four_bar

HOSTILE = "<b onmouseover=alert('1')>&\""
ESCAPED = "&lt;b onmouseover=alert(&#x27;1&#x27;)&gt;&amp;&quot;"


def test_tables_of_a_mechanism():
    text = four_bar()._repr_html_()
    assert "Mechanism of 3 links and 4 joints" in text
    assert text.count("<table>") == 2 and text.count("<tr>") == 4 + 5
    for word in ("crank", "rigid", "revolute", "-1.5708", "cut", "base"):
        assert f">{word}</td>" in text


def test_everything_of_a_study_is_escaped():
    ramp = MomentRamp("A", 1.5, 0.1)
    case = Case("P1", {"D.delta_x": 0.01})
    study = Study(HOSTILE, four_bar(), ramp, 0.1, RungeKutta4(step=1e-5), cases=(case,), note=HOSTILE)
    text = study._repr_html_()
    assert text.count(ESCAPED) == 2 and "<b onmouse" not in text
    assert (
        ">P1</td>" in text and "D.delta_x = 0.01" in text and "0.1 s by rk4 with steps of 1e-05 s; MomentRamp." in text
    )


def test_names_of_links_are_escaped():
    mechanism = four_bar()
    hostile = object.__new__(type(mechanism))
    links = [named(mechanism.links[0], HOSTILE), *mechanism.links[1:]]
    hostile.__dict__.update(vars(mechanism) | {"links": links})
    assert ESCAPED in hostile._repr_html_() and "<b onmouse" not in hostile._repr_html_()


def named(link, name):
    """A link that its own checks would refuse."""
    made = object.__new__(type(link))
    made.__dict__.update({one.name: getattr(link, one.name) for one in dataclasses.fields(link)} | {"name": name})
    return made


def test_cells():
    text = rich_text.table(["name", "value"], [["<a>", 1.0 / 3.0], ["b", float("nan")], ["c", None], ["d", 7]])
    for cell in ("&lt;a&gt;", "0.333333", "-", "7"):
        assert f">{cell}</td>" in text
    assert rich_text.preformatted("a\n<b>") == "<pre>a\n&lt;b&gt;</pre>"
