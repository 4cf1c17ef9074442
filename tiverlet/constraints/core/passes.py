"""The contract of constraints on the device: what each phase of a substep calls."""

from typing import Any

from ...device import ti


class Passes:
    """The contract of a batch on the device: its fields, and what the phases of a substep do with constraint c.

    Kernels inherit only methods that do nothing. Code that several kinds share is in objects that they hold.

    corners: FixedCorners or VariableCorners, its particles and slots. name: distinguishes it from other batches.
    """

    has_own_compile_time = True
    needs_reduce_block = False  # residual_of() needs reduce_block()
    corners: Any
    name: str

    def __repr__(self) -> str:
        return self.name

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Do one Jacobi correction in a substep of h [s]: write the move of each corner, its inverse mass included.

        h2_effective: what a constant acceleration adds to the displacement, per m/s^2: h^2, half of it at a start, less with
        drag [s^2]. frame_fraction: where in the frame the substep starts and ends, and its share of it.
        first: 1 in the first iteration of a substep. fresh: 1 at a start, the first substep after velocities were set.
        """

    @ti.func
    def push_spring_force(self, c, h, soft, alone):
        """Push what the constraint's spring, if it has one, adds to h^2 a at the present positions; for starts.

        soft: as in push_reaction(). alone: whether a single pass, in which every constraint acts by itself, made the multipliers.
        """

    @ti.func
    def note_spring_turn(self, c):
        """Where springs are forces (orders from 4 on): record how far it turned in the last stage, see Slots.record_turn."""

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push what the constraint adds to h^2 a, along its directions at the present positions, about which it has no moment.

        That is its move in the last substep, and for a spring also the change of its force since, see Spring.force_change().
        firm, soft: h^2 divided by the multiplier of 1 N, for rigid and for soft constraints. With firm = 0, rigid constraints
        push nothing.
        """

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """For VariableCorners, before relax() and push_spring_force(): sum over block b. first: -1 before push_spring_force()."""

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """For VariableCorners, after relax() and push_spring_force(): give corner e its move."""

    @ti.func
    def begin_answer(self, c, h, h2_effective, fresh, bodies: ti.template()):  # type: ignore[valid-type]
        """Before contacts are solved, where constraint c answers their impulses by itself: prepare for that."""

    @ti.func
    def turn_answer(self, c, bodies: ti.template()):  # type: ignore[valid-type]
        """Answer from where constraint c is at the time of an impact, or at the start of the substep without one."""

    @ti.func
    def answer(self, c, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Answer moves of its corners by impulses of contacts, `moved` - d: add to Slots.answer how far it moves them."""

    @ti.func
    def end_answer(self, c, rows: ti.template()):  # type: ignore[valid-type]
        """Add the answer of constraint c to its multiplier, and tell the part that came of a blow."""

    @ti.func
    def overload(self, c, h2_rigid, h2_effective):
        """Where the batch `breaks`: return the overload of constraint c, else 0. h2_rigid, h2_effective: multipliers of 1 N."""

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """Return how far constraint c is from fulfilled, relative to its size."""
        return 0.0

    @ti.func
    def softening(self, c, h2_effective, residual):
        """Return the work [J] of the load on what passes left of a violation, and on what compliance gives; 0 where rigid."""
        return ti.Vector.zero(ti.f64, 2)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Return the elastic energy [J] at x - back d. residual: of residual_of(). h2_effective: 0 before the first substep."""
        return 0.0
