"""Hinges that are driven by a motor."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.feature import Feature, Knob, Scene
from ..features.items import Items
from ..particles import Particles
from .core.angle import TURN, DihedralAngle, PathAngle
from .core.drive import Drive, driven_rest
from .core.scalar import Scalar

TIME_CONSTANT = 0.1  # [s] time constant with which a servo approaches its angle
PLACED = 0.2  # [rad] hinges that were placed further than this from their rest angle continue from their new angle


def _refuse_endless(motor: Any, angle: np.ndarray) -> None:
    if not motor.serves:
        raise ValueError("Motor: angle cannot be set: it turns at a speed. Make a Motor with angle=... for one that holds it.")


class Motor(Scalar):
    """Motors: the angle of a hinge turns at a given speed, or to a given angle, with a largest torque.

    C(x) = f(x) - rest with the angle f [rad] and its gradients of Bend (triples) or Dihedral (quads). In a substep h the rest
    angle turns by speed h, or by at most speed h towards `angle`. Its multiplier is clamped, |lam| <= torque h^2. Below the
    largest torque the hinge turns at the given speed; at the limit it exerts the largest torque; see
    tiverlet/constraints/README.md. All torques act between its particles, so a motor moves no center of mass and gives no angular
    momentum.

    hinges: (m, 3) particle indices, the corner in the middle, of joints in a plane: a wheel turns by i - j - k where i is on the
    frame, j the hub and k on the wheel. (m, 4) of hinges in 3D: the two ends of the axis, then a particle of either side.
    speed: number or (m,) [rad/s]; positive to the left in 2D. 0 holds: a brake of dry friction, if the torque is finite. Live.
    angle: number or (m,) [rad]; a servo turns to this angle by the shorter way and stays there. It turns at |speed|, and at most
    at the remaining angle per 0.1 s. Live. None: turn without end; an angle cannot be given later.
    torque: the largest torque, number or (m,) [N m]. Live. 0 lets the hinge turn freely. Without it the motor meets any load, and
    a stop in its way bears whatever the motor exerts.
    compliance: number or (m,) [rad/(N m)] of a spring between the motor and the hinge; 0 is rigid. damping: [N m s/rad] parallel
    to it. break_at: moment at which it breaks, number or (m,) [N m].

    In 3D the angle of triples lies in [0, pi], and a motor stops at either end; take quads for more.
    `load` is the moment of the hinge against increasing angles [N m]: -load is the torque of the motor, and -load times the speed
    its power. `rest` is the current rest angle [rad]: under a load the angle lags behind by what bears the load, as in a Bend.
    """

    host_only = ("_begin",)

    index_name = "hinges"
    driven = True
    each = ("speed", "angle", "torque", "compliance", "damping", "break_at")
    speed = Knob(Items("speed"), "Angular velocity [rad/s].")
    angle = Knob(Items("angle", _refuse_endless, least=-TURN, most=TURN), "Where to turn to [rad].")
    rest = driven_rest("_begin", "The current rest angles [rad], (m,).")
    torque = Knob(Items("torque", least=0.0, infinite=True), "The largest torque [N m].")

    def __init__(
        self, hinges, speed: ArrayLike, *, angle=None, torque: ArrayLike = np.inf, compliance: ArrayLike = 0.0, damping:
        ArrayLike = 0.0, break_at=None,
    ):  # fmt: skip
        hinges = np.asarray(hinges)
        self.measures = DihedralAngle if hinges.ndim == 2 and hinges.shape[1] == 4 else PathAngle
        self.serves = angle is not None
        self.setup(hinges, None, compliance, damping, break_at)
        self.speed, self.torque = speed, torque
        if angle is not None:
            self.angle = angle

    def check_extension(self, more: Feature) -> None:
        """Raise TypeError unless both motors turn at a speed, or both to angles."""
        super().check_extension(more)
        if more.serves != self.serves:  # type: ignore[attr-defined]
            raise TypeError("World.add: extend: one Motor turns to an angle, and the other at a speed. Add it to features.")

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices and angles against the dimension, and take the initial angles as rest angles."""
        self.check_indices(particles)
        if particles.dim == 2 and self.arity == 4:
            raise ValueError("Motor: there is no hinge of four particles in 2D. Use triples (i, j, k), the joint in the middle.")
        if self.serves and particles.dim == 3 and self.arity == 3:
            checks.per_item("Motor", "angle (of triples in 3D)", self.angle, self.count, least=0.0, most=np.pi)
        self._begin = self.rest_of(particles.position)

    def drive_of(self, scene: Scene) -> Drive:
        """Make the drive, which goes to the angle, or on without end."""
        ends = scene.state.dim == 3 and self.arity == 3  # at 0 and pi
        endless, period = not (self.serves or ends), 0.0 if ends else TURN
        return Drive(scene, self, self._begin, endless, period, TIME_CONSTANT * self.serves)

    def course(self) -> tuple[Any, Any, Any]:
        """Return the goals of the rest angles [rad], the speeds [rad/s] and the largest torques [N m]."""
        return self.angle if self.serves else np.where(self.speed > 0, np.pi, 0.0), self.speed, self.torque

    def start_at(self, position: np.ndarray, first: int) -> None:
        """Move the rest angles of hinges with placed particles to where the hinges are now."""
        far = (np.abs(self.violation(position)) > PLACED) & (self.indices >= first).any(axis=1)
        if far.any():
            self.dev.drive.put(np.where(far, self.rest_of(position), self.rest))
