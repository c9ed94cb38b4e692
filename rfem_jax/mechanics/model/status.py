"""The status of one assembly or one run: failure is data, so that a batch goes on.

Place in the pipeline: statics and simulation set it, everything after them reads it.

Codes are int32 scalars in traced code; `STATUS[code]` has the short name (as in results.json) and
the full message.  The order of the codes is no ranking: the first failure of a run is kept.
"""

from typing import NamedTuple


class Status(NamedTuple):
    """A short name, and a message: what happened, the usual cause, other causes."""

    name: str
    message: str


OK, NOT_ASSEMBLED, WRONG_SIDE, DIVERGED, DRIFTED, STEPS_EXHAUSTED, OUT_OF_RANGE, NOT_CONVERGED = range(8)
NOT_CLOSED, DESIGN_OUT_OF_RANGE, CONTACT_NOT_RESOLVED, PAST_LIMIT = 8, 9, 10, 11
CANNOT_CLOSE, NO_EQUILIBRIUM, NOT_BALANCED, UNSTABLE, NO_MODES = 12, 13, 14, 15, 16

STATUS: tuple[Status, ...] = (
    Status("ok", "The run is complete and passed its checks."),
    Status(
        "not_assembled",
        "No static equilibrium was found for the start. Usually an error is so large that links or bearings "
        "deflect too far (of links beyond the linear spring-damping elements: use geometrically exact ones); a wrong "
        "start angle, or a freedom that nothing holds, does the same.",
    ),
    Status(
        "wrong_side",
        "A cut joint closed with its two hinge axes antiparallel. Usually a start angle is on the "
        "wrong branch; turn the child's frame by 180 deg if this is how the joint is built.",
    ),
    Status(
        "diverged",
        "A coordinate became infinite or undefined. Usually the step is too large for stability "
        "(`rfem-jax check` prints the largest stable one); a link that bends by more than 90 deg, or a drive that "
        "prescribes positions at which the loops do not close, has the same effect.",
    ),
    Status(
        "drifted",
        "A cut joint opened by more than a millionth of the longest link. Usually the step is too "
        "large; too weak a stabilisation does the same.",
    ),
    Status(
        "steps_exhausted",
        "The adaptive method, or the implicit one that follows contacts, used up its steps. Usually the motion is "
        "stiffer than the method can follow; use a fixed step or looser tolerances, with clearances a shorter step.",
    ),
    Status(
        "out_of_range",
        "A rigid finite element rotated too far in its link frame: beyond 60 deg with linear "
        "spring-damping elements, whose results are inaccurate well below that (use elements = "
        '"geometrically_exact"); with geometrically exact ones beyond 80 deg out of the plane of '
        "motion, where their angles become singular.",
    ),
    Status(
        "not_converged",
        "The residual of the equations of motion after an implicit step exceeded a twentieth of the "
        "largest joint force. Usually the step is too large for the motion, or the method's "
        "`corrections` are too few; links that bend far do the same.",
    ),
    Status(
        "not_closed",
        "The loops of the design cannot be closed at the start with every link rigid: they stay open by what the run "
        "says. Usually a length or a joint is too far from the others; the nominal mechanism was computed instead.",
    ),
    Status(
        "design_out_of_range",
        "A number of the design, or what an error makes of it, is impossible (a length, a dimension of a section or a "
        "stiffness that is not positive, a tilt of more than half a turn), or a joint, a mass or a force lies further "
        "from the rigid finite element that holds it than half of one; correct the number, or describe the mechanism "
        "anew. The nominal one was computed instead.",
    ),
    Status(
        "contact_not_resolved",
        "The energy of a mechanism with clearance is off by more than 3 %. Usually the steps are too long for "
        "its contacts, which last some ten microseconds where parts of steel strike: take the implicit method, whose "
        "steps follow contacts, with a smaller `contact_tolerance`, an adaptive method, or steps of a tenth of that.",
    ),
    Status(
        "past_limit",
        "The drive prescribes a position at which the loops do not close: the mechanism locks there, whatever the step "
        "(`rfem-jax check` says when and where). Prescribe a shorter way, or change lengths and positions.",
    ),
    Status(
        "cannot_close",
        "With its errors a loop of rigid links cannot be put together, because nothing in it gives. Make one of its "
        "links flexible, or let one of its bearings give (a compliance or a clearance); or leave out the errors that "
        "open it, in planar loops those across the plane.",
    ),
    Status(
        "no_equilibrium",
        "The rigid links have no static equilibrium that can be found: nothing holds a freedom, such as that of a body "
        "that "
        'slides down a guide or hangs on a ball joint alone. Let it start as given (start = "as_given"), or hold it by '
        "a spring or a drive.",
    ),
    Status(
        "not_balanced",
        "The energies, or the joint forces and the rate of momentum, are off by more than 3 % of what is exchanged or "
        "carried. Usually the step is too long for the motion, for a stiff stop, or for a table over "
        "position whose rows are passed within it: halve it until the balances are far below a hundredth, or take the "
        'method "auto"; a rigid mechanism at a change point does the same.',
    ),
    Status(
        "unstable",
        "The static equilibrium that was found is unstable: the slightest disturbance makes the mechanism leave it, so "
        "that these loads and places are not those of rest. Usually a link carries more than its buckling load; a "
        "pendulum on its head and a toggle at its dead centre do the same. Reduce the load or make the link stiffer; "
        "hold the freedom; or start beside the equilibrium, or with a small error or force, to find the stable one. A "
        "simulation may start there.",
    ),
    Status(
        "no_modes",
        "The equilibrium was found, but the frequencies or modes about it are not finite numbers: the matrix of masses "
        "cannot be factored. Usually a body has next to no inertia beside a heavy one that turns or slides along the "
        "same line (ten powers of ten are enough apart); give it a mass and moments of inertia.",
    ),
)
