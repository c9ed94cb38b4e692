"""Parts that study files of tests share: steel, a section, links, an arm on a hinge in the base."""

STEEL = """
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
"""


def rectangle(width: str = '"10 mm"', height: str = '"10 mm"') -> str:
    """The section `bar`."""
    return f'[mechanism.sections.bar]\nshape = "rectangle"\nwidth = {width}\nheight = {height}\n'


ROUND = '[mechanism.sections.bar]\nshape = "circle"\ndiameter = "10 mm"\n'


def link(name: str, length: float, body: str = "rigid = true") -> str:
    """A link of that section and steel."""
    return f'[[mechanism.links]]\nname = "{name}"\nlength = {length}\nsection = "bar"\nmaterial = "steel"\n{body}\n'


def hinge(child: str, more: str = "") -> str:
    """The hinge A in the base."""
    return f'[[mechanism.joints]]\nname = "A"\nparent = "base"\nchild = "{child}"\n{more}\n'
