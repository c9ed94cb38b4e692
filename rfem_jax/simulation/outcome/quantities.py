"""Names, units and labels of everything that a run has and that is reported.

Place in the pipeline: read by `labelled_runs` and by `summary`, `tables`, `files` and `figures` of `report`, so that a
quantity is called the same, and has the same unit, in a Dataset, in a notebook, in the terminal, in `results.json`, in
the CSV files and in the pictures. SI units and radians throughout.
"""

from dataclasses import dataclass

from rfem_jax.labelled_data import column_name as column_name


@dataclass(frozen=True)
class Quantity:
    """A reported quantity: `name` in files, `unit`, `label` for people, `description`."""

    name: str
    unit: str
    label: str
    description: str

    @property
    def title(self) -> str:
        """Label with unit, as table headings and axis names show it."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


RMS_FORCE = Quantity("rms_force", "N", "RMS resultant force", "root of the mean square over the whole run")
RMS_MOMENT = Quantity("rms_moment", "N m", "RMS resultant moment", "root of the mean square over the whole run")
MAX_AXIAL_FORCE = Quantity(
    "max_axial_force", "N", "Maximum axial force", "largest |force along the joint's axis, hinge or guide| of the run"
)
MAX_NORMAL_FORCE = Quantity(
    "max_normal_force", "N", "Maximum normal force", "largest resultant across the axis of the run"
)
MAX_FORCE = Quantity("max_force", "N", "Maximum resultant force", "largest of all steps of the run")
MAX_MOMENT = Quantity("max_moment", "N m", "Maximum resultant moment", "largest of all steps of the run")
MEAN_SQUARES = (
    Quantity("mean_square_force", "N^2", "Mean square of the resultant force", "over the whole run"),
    Quantity("mean_square_moment", "(N m)^2", "Mean square of the resultant moment", "over the whole run"),
)
JOINT_METRICS = (RMS_FORCE, RMS_MOMENT, MAX_FORCE, MAX_MOMENT, MAX_AXIAL_FORCE, MAX_NORMAL_FORCE)

PRELOAD_FORCE = Quantity(
    "preload_force", "N", "Preload force", "force at the start, holding loads included, x y z of the frame H"
)
PRELOAD_MOMENT = Quantity(
    "preload_moment", "N m", "Preload moment", "moment at the start, holding loads included, x y z of the frame H"
)
PRELOADS = (PRELOAD_FORCE, PRELOAD_MOMENT)
AT_REST = tuple(
    Quantity(one.name, one.unit, f"Resultant {what} at rest", "at the start, holding loads included: the preload")
    for one, what in zip(PRELOADS, ("force", "moment"), strict=True)
)

ANGLE_END = Quantity("angle_end", "rad", "Angle at end", "the driven joint's own coordinate")
RATE_END = Quantity("rate_end", "rad/s", "Rate at end", "rate of the driven joint's coordinate")
POSITION_END = Quantity("position_end", "m", "Position at end", "displacement of a driven joint")
RMS_COMPONENTS = "rms_components"  # of force and moment, x y z of the frame H
FRICTION_LOSS = Quantity("friction_loss", "J", "Friction loss", "energy that a friction has dissipated over the run")

DRIVEN_JOINT = (ANGLE_END, RATE_END)

CONTACTS = (
    Quantity("largest_penetration", "m", "Largest penetration", "of the pin in its bush, at the saved times"),
    Quantity("largest_contact_force", "N", "Largest contact force", "of one end of the pin, or of its axial stop"),
    Quantity("carrying_share", "", "Share of time in contact", "by the ends of the pin and its axial stop"),
    Quantity("contact_loss", "J", "Contact loss", "energy that the contacts have dissipated over the run"),
)

CONTACT_CHANGES = Quantity("contact_changes", "", "Changes of contact", "how often a contact has closed or opened")

BALANCES = (
    Quantity(
        "energy_balance_error",
        "",
        "Energy balance",
        "largest change of total - work + dissipation, over the energy that is exchanged",
    ),
    Quantity("closure_drift", "m", "Drift", "largest distance of the two centres of a cut joint"),
    Quantity("closure_drift_angle", "rad", "Drift angle", "largest residual of the axis equations"),
    Quantity(
        "momentum_balance_error",
        "",
        "Momentum balance",
        "base reactions + gravity + drive - d/dt momentum, divided by the largest load",
    ),
    Quantity(
        "stabilisation_share",
        "",
        "Baumgarte share",
        "largest Baumgarte part of the multipliers, divided by the largest multiplier",
    ),
    Quantity(
        "solution_residual",
        "",
        "Newton residual",
        "largest residual force of an implicit step, divided by the largest joint force",
    ),
)

LINEAR_ERROR = Quantity(
    "linear_error",
    "",
    "Error of linear elements",
    "estimated, relative to the deflections of the link that is worst",
)
CHECKS = (*BALANCES, LINEAR_ERROR)
HINGE_MOMENT_ERROR = Quantity(
    "hinge_moment_error", "", "Moment about free axes", "beyond the forces in the joints, relative"
)

ENERGIES = (
    Quantity("kinetic", "J", "Kinetic energy", "of all links"),
    Quantity("elastic", "J", "Elastic energy", "of the flexible links and springs"),
    Quantity("gravity", "J", "Gravitational energy", "potential energy of the weight"),
    Quantity("total", "J", "Total mechanical energy", "kinetic + elastic + gravity"),
    Quantity("work", "J", "Work of the drive", "and of forces from outside, done since the start"),
    Quantity("dissipation", "J", "Dissipated energy", "lost in material damping, dampers and friction since the start"),
)


def units() -> dict[str, str]:
    """Unit of every number in `results.json` by its name ("1" where it has no dimension)."""
    listed = (
        *PRELOADS,
        *JOINT_METRICS,
        *DRIVEN_JOINT,
        POSITION_END,
        FRICTION_LOSS,
        *CONTACTS,
        CONTACT_CHANGES,
        *CHECKS,
    )
    return {**{quantity.name: quantity.unit or "1" for quantity in listed}, RMS_COMPONENTS: "N, N m"}
