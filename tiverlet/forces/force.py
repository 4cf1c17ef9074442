"""The user's own force."""

import inspect
from typing import Any

import numpy as np

from ..device import inline, ti
from ..device.language import Expression, is_kernel_function, undecorated
from ..device.patches.compiler import readable, refuse
from ..features.feature import Acceleration, Scene
from ..particles import Particles


class Force(Acceleration):
    """F = function(x), function(x, v), function(x, v, t) or function(x, v, t, i): the user's own force in newtons.

    function: a ti.func that takes position [m], velocity [m/s], time [s] and index of one particle, as many of these as
    it names, and returns a vector [N]. Its literals have the world's precision. Numbers that it reads from Python are frozen when
    the world is first stepped; put what changes into a Taichi field, or into t.

        @ti.func
        def spring(x):
            return -100.0 * x

        world = tv.World(particles, [tv.Force(spring)])

    Position Verlet is second order in h as long as h times the force's fastest frequency stays below 2, and diverges beyond;
    the step then flags "stiff-force" and says how many substeps resolve it. When the function takes v, v is solved for together
    with the force, which calls it five times a substep in 2D, six times in 3D, and takes one more field: what turns v keeps the
    speed, what brakes does not overshoot, whatever h is, see tiverlet/forces/README.md.
    """

    for_all = True

    def __init__(self, function):
        self.arity = check_function("Force", "function", function, ("x", "v", "t", "i"), (1, 2, 3, 4))
        self.function = function
        self.uses_velocity = self.arity >= 2

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Nothing to check before the function is compiled."""

    def bind(self, scene: Scene) -> None:
        """No field of its own."""
        self.scene = scene
        self.dev.w, self.dev.dim = scene.state.w, scene.particles.dim

    @inline
    def force(self, value):
        """What the function returned, if it is a vector; as a number it would be added to all components."""
        return check_vector("Force", undecorated(self.function).__name__, value, self.dev.dim)

    @ti.func
    def acceleration(self, i, x, v, t):
        """F / m."""
        out = 0 * x
        if ti.static(self.arity == 1):
            out = self.force(self.function(x))
        elif ti.static(self.arity == 2):
            out = self.force(self.function(x, v))
        elif ti.static(self.arity == 3):
            out = self.force(self.function(x, v, t))
        else:
            out = self.force(self.function(x, v, t, i))
        return self.dev.w.of(i) * out


def check_function(who: str, name: str, function: Any, takes: tuple[str, ...], counts: tuple[int, ...]) -> int:
    """How many arguments a ti.func of the user's takes, which must be one of `counts`, of those in `takes`."""
    if not is_kernel_function(function):
        raise TypeError(
            f"{who}: {name} = {function!r} is not a Taichi function. Put the decorator @ti.func above its def "
            "(import taichi as ti), in a file: Taichi reads its source."
        )
    plain = undecorated(function)
    if not readable(plain):
        raise ValueError(
            f"{who}: the source of {plain.__name__} cannot be read, and Taichi compiles the source. Write it in a file or "
            "in a notebook; what is typed in a console is not kept."
        )
    names = list(inspect.signature(plain).parameters)
    if len(names) not in counts:
        some = f"{counts[0]} to {counts[-1]}" if len(counts) == counts[-1] else " or ".join(map(str, counts))
        raise TypeError(f"{who}: {name} takes {names}, but it must take {some} of ({', '.join(takes)}), in this order.")
    return len(names)


def check_vector(who: str, name: str, value: Any, dim: int) -> Any:
    """What a function returned, if it is a vector; as a number it would be added to all components."""
    known = isinstance(value, Expression)
    shape = (tuple(value.get_shape()) if value.is_tensor() else ()) if known else np.shape(value)
    if shape != (dim,):
        what = f"{shape[0]} components" if len(shape) == 1 else f"a matrix of shape {shape}" if shape else "a number"
        refuse(TypeError(f"{who}: {name} returns {what}, but in {dim}D a force has {dim} components [N]: ti.Vector([...])."))
    return value
