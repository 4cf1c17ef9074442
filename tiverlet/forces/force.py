"""The user's own force."""

import inspect

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
    the step then flags "stiff-force" and says how many substeps resolve it. When the function takes v, its velocity is
    known to second order, at the cost of one more field.
    """

    def __init__(self, function):
        if not is_kernel_function(function):
            raise TypeError(
                f"Force: function = {function!r} is not a Taichi function. Put the decorator @ti.func above its def "
                "(import taichi as ti), in a file: Taichi reads its source."
            )
        plain = undecorated(function)
        if not readable(plain):
            raise ValueError(
                f"Force: the source of {plain.__name__} cannot be read, and Taichi compiles the source. Write it in a file or "
                "in a notebook; what is typed in a console is not kept."
            )
        names = list(inspect.signature(plain).parameters)
        if not 1 <= len(names) <= 4:
            raise TypeError(f"Force: function takes {names}, but it must take 1 to 4 of (x, v, t, i), in this order.")
        self.function = function
        self.arity = len(names)
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
        dim, name = self.dev.dim, undecorated(self.function).__name__
        known = isinstance(value, Expression)
        shape = (tuple(value.get_shape()) if value.is_tensor() else ()) if known else np.shape(value)
        if shape != (dim,):
            what = f"{shape[0]} components" if len(shape) == 1 else f"a matrix of shape {shape}" if shape else "a number"
            refuse(TypeError(f"Force: {name} returns {what}, but in {dim}D a force has {dim} components [N]: ti.Vector([...])."))
        return value

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
