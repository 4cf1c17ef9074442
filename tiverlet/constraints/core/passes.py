"""What a substep asks of constraints on the device."""

from typing import Any

from ...device import ti


class Passes:
    """The contract of a batch on the device: its fields, and what the passes of a substep do with constraint c. Kernels inherit
    nothing but what does nothing: what several kinds share is an object that they hold.

    corners: FixedCorners or VariableCorners, its particles and slots. name: as it is told apart by.
    """

    told_apart = True
    corners: Any
    name: str

    def __repr__(self) -> str:
        return self.name

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """One Jacobi correction in a substep of h [s]: gives each corner the move that it wants, times its inverse mass.

        h2_effective: what a constant acceleration adds to the displacement, per m/s^2: h^2, half of it at a start, less with
        drag [s^2]. frame_fraction: where in the frame the substep starts and ends, for targets that move.
        first: 1 in the first iteration of a substep. fresh: 1 in the first substep after a start.
        """

    @ti.func
    def push_spring_force(self, c, h):
        """Push what the constraint's spring, if it has one, adds to h^2 a at the present positions; for starts."""

    @ti.func
    def note_spring_turn(self, c):
        """Where springs are forces (orders from 4 on): note how far this one turned in the last stage, see Slots.note_turn."""

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push what the constraint adds to h^2 a, along its directions at the present positions, about which it has no moment:
        what it did in the last substep, and of a spring, how much its force has changed since, see Spring.change().

        firm, soft: h^2 over what its multiplier stands for, where it is rigid and where not. With firm = 0, what is rigid pushes
        nothing, not even a load that it knows.
        """

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """Of VariableCorners, before relax() and push_spring_force(): sum over block b. first: -1 before the latter."""

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """Of VariableCorners, after relax() and push_spring_force(): give corner e its move."""

    @ti.func
    def break_overloaded(self, c, h2_rigid, h2_effective, tick):
        """Where it `breaks`: break constraint c if its load in this substep was too large; it acts no more from the next on.
        h2_rigid, h2_effective: its multiplier for 1 N, where it is rigid and where not."""

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """How far constraint c is from fulfilled, relative to its size."""
        return 0.0

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Elastic energy [J] at x - back d. residual: what residual_of() returns. h2_effective: as in relax(), 0 where there was
        no substep yet."""
        return 0.0
