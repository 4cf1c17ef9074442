"""The user's own force."""

from ..device import inline, ti
from ..device.language import undecorated
from ..features.feature import Acceleration, Scene
from ..features.user_function import check_function, check_vector


class Force(Acceleration):
    """The user's own force [N]: function(x), function(x, v), function(x, v, t) or function(x, v, t, i).

    function: a ti.func of position [m], velocity [m/s], time [s] and index of one particle. It takes as many of these as it
    names, and returns a vector [N]. Its literals have the world's precision. Numbers that it reads from Python are frozen when
    the world is first stepped; put changing numbers into a Taichi field, or compute them from t.

        @ti.func
        def spring(x):
            return -100.0 * x

        world = tv.World(particles, [tv.Force(spring)])

    Position Verlet is second order in h as long as h times the force's fastest frequency stays below 2, and diverges beyond. The
    step then flags "stiff-force" and says how many substeps resolve it.

    If the function takes v, v is solved for together with the force. This calls the function five times a substep in 2D, six
    times in 3D, and takes one more field. A force that turns v keeps the speed, and a force that brakes does not overshoot,
    whatever h is, see tiverlet/forces/README.md.
    """

    has_no_particle_data = True

    def __init__(self, function):
        self.arity = check_function("Force", "function", function, ("x", "v", "t", "i"), (1, 2, 3, 4))
        self.function = function
        self.uses_velocity = self.arity >= 2

    def bind(self, scene: Scene) -> None:
        """Store the scene. The force has no field of its own."""
        self.scene = scene
        self.dev.w = scene.state.w

    @inline
    def force(self, *arguments):
        """Return the value of the function if it is a vector, else refuse it."""
        value = self.function(*arguments[: self.arity])
        return check_vector("Force", undecorated(self.function).__name__, value, self.dim)

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return F / m [m/s^2]."""
        out = 0 * x  # of the type of x, whatever the function returns
        out = self.force(x, v, t, i)
        return self.dev.w[i] * out
