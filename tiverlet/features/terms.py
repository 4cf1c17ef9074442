"""Terms of other programs, and what they are called here.

By the class, module or function that is asked for a name; rows of a class hold for its subclasses, too. Each row: names, and
the clause that ends the error. Names are compared without case, underscores, and a get or set before them. Every call, keyword
and attribute in a clause exists: tests/test_terms.py looks each of them up.
"""

FEATURES = "forces, constraints and walls are features; write tv.World(particles, features), and read world.features"
MATERIAL = "it belongs to contacts and walls; write tv.Contact(friction=..., restitution=...)"
MASSLESS = "walls have no mass: they move as you assign their knobs; bodies that move are made of tv.Particles(position)"
COLOUR = "it belongs to pictures, by body unless you write tv.Recorder(path, world, color=...) or tv.play(world, color=...)"
SUBSTEPS = "it is a setting of the world; write world.substeps = 20 or world.iterations = 4"
ROWS: dict[str, dict[str, str]] = {
    "tiverlet": {
        "Space Engine Simulation Simulator Scene System Sim Model Composite Solver": "write tv.World(particles, features)",
        "Body Bodies Particle ParticleSystem Atoms Points Nodes": "write tv.Particles(position, mass=..., radius=...)",
        "RigidBody Rigid": "bodies are made of particles; write tv.ShapeMatch(clusters) or tv.Polygons(loops)",
        "SoftBody Jelly Squishy": "write tv.ShapeMatch(clusters, compliance=...)",
        "Circle Disc Disk Sphere": "write tv.Particles(position, radius=...) for what moves, tv.Ball(center, radius) for a wall",
        "Spring DampedSpring SpringJoint Damper Dashpot": "write tv.Distance(pairs, rest, compliance=1 / stiffness, damping=...)",
        "Link Rod Stick Bond Edge DistanceJoint DistanceConstraint PinJoint": "write tv.Distance(pairs)",
        "RopeJoint SlideJoint Cable MaxDistance": "write tv.Rope(pairs, length)",
        "RevoluteJoint PivotJoint Hinge HingeJoint BallJoint Joint": "write tv.Pin(indices), or let bodies share a particle",
        "PrismaticJoint GrooveJoint Slider Rail Wire": "write tv.Path(indices, points)",
        "SimpleMotor MotorJoint WheelJoint RotaryMotor": "write tv.Motor(hinges, speed)",
        "Pulley PulleyJoint": "write tv.Winch(pairs, speed)",
        "Anchor Attachment Fixed FixedJoint WeldJoint PinConstraint": "write tv.Pin(indices)",
        "Bending": "write tv.Bend(triples)",
        "Angle AngleConstraint RotaryLimitJoint": "write tv.AngleLimit(triples, lower, upper)",
        "MouseJoint MouseConstraint Mouse Grab Grabber": "write tv.Hand(target)",
        "Segment Line EdgeShape": "write tv.Capsule(a, b, radius)",
        "Plane Ground Floor Wall StaticBody": "write tv.HalfSpace(normal, offset)",
        "Bounds Boundary Container Cube Rectangle Walls AABB": "write tv.Box(lower, upper)",
        "Poly PolygonShape": "write tv.Polygon(points) for a wall, tv.Polygons(loops) for bodies",
        "Heightfield TriMesh TriangleMesh": "write tv.Mesh(vertices, faces)",
        "Collision Collisions SelfCollision Collider Friction": "write tv.Contact(friction, restitution)",
        "LennardJones PairStyle PairPotential Coulomb Interaction": "write tv.PairForce(function, radius)",
        "Damping AirResistance Viscosity LinearDamping": "write tv.Drag(rate)",
        "PointGravity Magnet CentralForce": "write tv.Attractor(center, strength)",
        "ForceField ExternalForce Turbulence Vortex": "write tv.Force(function)",
        "PBC PeriodicBox PeriodicBoundary": "write tv.Periodic(low, high)",
        "Vec2 Vec2d Vec3 Vector": "a point is a tuple, or a row of an array",
        "Writer Recording Film Video dump record": "write tv.Recorder(path, world)",
        "open read": "write tv.load(path) for worlds, tv.replay(path) for recordings, tv.shapes.load(path) for OBJ and PLY files",
        "show render view viewer draw gui": "write tv.play(world)",
        "XPBD PBD GaussSeidel": "write tv.World(particles, features, solver=tv.Jacobi())",
        "arch backend gpu": 'write tv.init(arch="cuda")',
    },
    "tiverlet.measure": {"potential_energy energy total_energy": "write world.last.energy"},
    "World": {
        "mass masses m": "write world.particles.mass",
        "radius radii": "write world.particles.radius",
        "pinned fixed static": "write world.particles.pinned",
        "n count size num_particles natoms": "write len(world.particles)",
        "dim ndim dimension": "write world.particles.dim",
        "x pos positions coordinates": "write world.position",
        "v vel velocities": "write world.velocity",
        "angular_velocity omega": "write world.spin",
        "angle angles rotation": "write world.orientation",
        "energy total_energy potential_energy": "write world.last.energy",
        "kinetic_energy ke": "write tv.measure.kinetic_energy(world)",
        "momentum": "write tv.measure.momentum(world)",
        "angular_momentum": "write tv.measure.angular_momentum(world)",
        "center_of_mass com": "write tv.measure.center_of_mass(world)",
        "t clock elapsed": "write world.time",
        "dt timestep time_step": "each frame is given its length; write world.step(dt) or world.run(seconds, dt)",
        "gravity g": "it is a feature; write tv.World(particles, [tv.Gravity(9.81)]), and assign to gravity.g to change it",
        "force forces acceleration apply_force add_force": "write tv.Force(function) in features; load of a feature is its force",
        "apply_impulse impulse": "assign the velocity after it: write world.velocity = velocity",
        "bodies joints constraints shapes walls colliders objects contact": FEATURES,
        "add_body add_bodies create_body add_particle add_particles add_constraint add_joint spawn insert":
            "write world.add(particles, features=[...])",
        "remove_body destroy_body delete_particles remove_constraint delete": "write world.remove(indices, features=[...])",
        "update advance tick simulate integrate": "write world.step(dt)",
        "raycast ray_cast segment_query": "write world.ray(origin, direction)",
        "query point_query neighbours neighbors": "write world.near(points, radius)",
        "collisions": "write world.contacts, or world.events() with tv.Contact(events=True)",
        "export dump write record": "write tv.Recorder(path, world), and tv.replay(path) to read and export it",
        "load restore load_state": "write tv.load(path)",
        "state copy deepcopy snapshot reset": "write start = world.clone() before, and go on with start",
        "show render view draw plot": "write tv.play(world)",
        "damping linear_damping": "write tv.Drag(rate) in features",
        "friction restitution elasticity": MATERIAL,
        "color colors": COLOUR,
        "velocity_iterations position_iterations solver_iterations": "write tv.World(particles, features, iterations=...)",
        "backend device arch gpu": 'write tv.init(arch="cuda") before',
        "dtype float_type": 'write tv.World(particles, features, precision="f64")',
        "seed": "write tv.init(seed=...) before",
    },
    "World.step World.run": {
        "timestep time_step delta delta_time": "write dt=... [s]",
        "substeps iterations velocity_iterations position_iterations": SUBSTEPS,
        "steps frames num_steps n": "write world.run(seconds, dt), of seconds / dt frames",
        "duration time until t total_time": "write seconds=...",
        "record output path film video filename": "write recorder=..., a path or a tv.Recorder(path, world)",
        "error tol accuracy": "write tolerance=...",
    },
    "Worlds": {
        "envs": "write worlds[k]",
        "n num_worlds num_envs size": "write len(worlds) and tv.Worlds(world, count)",
        "particles mass radius": "write worlds[k].particles",
        "state": "write worlds.position and worlds.velocity",
    },
    "Particles": {
        "x pos points coordinates": "write position",
        "v vel velocities": "write velocity",
        "m weight": "write mass",
        "r size": "write radius",
        "diameter": "write radius=diameter / 2",
        "density rho": "write mass=density * volume, in 2D np.pi * radius**2 times a depth",
        "fixed static kinematic anchored locked inv_mass inverse_mass": "write pinned, the indices of those that stay in place",
        "friction restitution elasticity bounce mu": MATERIAL,
        "color colors": COLOUR,
        "angle rotation angles": "write orientation",
        "angular_velocity omega w": "write spin",
        "moment moment_of_inertia": "write inertia, in units of mass radius^2",
        "charge q": "write tv.PairForce(function), whose function reads it by the numbers i and j",
        "type species category layer mask collision_filter collision_type filter": "write group",
        "n num_particles": "the number of particles is len(position)",
        "force forces": "write tv.Force(function) in the features of the world",
        "damping": "write tv.Drag(rate) in the features of the world",
    },
    "Feature": {
        "color": COLOUR,
        "name label": "keep the feature in a variable of your own, and find it in world.features",
    },
    "Batch": {
        "stiffness k spring_constant youngs_modulus strength spring_stiffness": "write compliance = 1 / stiffness",
        "rest_length length l0 distance equilibrium rest_angle rest_volume": "write rest",
        "damping_ratio damping_coefficient damper c": "write damping, of a dashpot beside the spring [N s/m]",
        "frequency frequency_hz": "write compliance = 1 / (mass * (2 * np.pi * frequency)**2)",
        "max_force break_force breaking_force max_load breakable breaking_threshold": "write break_at, a load [N]",
        "force forces tension reaction impulse": "write load",
        "violation error": "write residual",
        "is_broken": "write broken",
        "a b body_a body_b node_a node_b edges links joints particles i j":
            "its first argument has the indices of the particles, one row per constraint",
        "enabled active": "write world.remove(features=[...]) and world.add(features=[...])",
        "iterations relaxation": "it is a setting of the world; write tv.World(particles, features, iterations=...)",
    },
    "Rope Spacer": {"rest rest_length max_length l0 distance": "write length"},
    "Pin Hand": {"position anchor point goal": "write target"},
    "Collider": {
        "elasticity bounce bounciness": "write restitution",
        "mu static_friction dynamic_friction friction_static": "write friction, a number or (static, dynamic)",
        "velocity speed belt conveyor": "write surface_velocity for belts; a wall that moves is assigned its new place",
        "mass density": MASSLESS,
        "group layer filter category": "walls touch all particles; groups are those of tv.Contact(groups=...)",
        "enabled is_active": "write active",
        "sensor is_sensor trigger is_trigger": "write events=True, or ask world.inside(shape)",
        "one_way": "Capsule, Polygon and Mesh take it",
    },
    "Box": {
        "min low lo lower_bound corner": "write lower",
        "max high hi upper_bound": "write upper",
        "size width height half_extents extents center dimensions": "write its corners: tv.Box(lower, upper)",
    },
    "HalfSpace": {"point position origin center height level y": "write offset, which is the normal times a point of it"},
    "Ball": {"r": "write radius", "position pos": "write center", "hollow inverted container": "write inside=True"},
    "Capsule": {"start begin p1 point_a": "write a", "end p2 point_b": "write b", "thickness width r": "write radius"},
    "Polygon Mesh": {"angle orientation": "write rotation", "center pos": "write position", "thickness": "write radius"},
    "PairContact": {
        "stiffness k kn compliance penalty": "contacts are rigid: nothing is to be set; see friction and restitution",
        "elasticity bounce bounciness damping": "write restitution",
        "mu static_friction": "write friction",
        "margin slop threshold cutoff": "particles touch at the sum of their radii; skin only sets how far pairs are listed",
        "radius thickness": "write tv.Particles(position, radius=...)",
        "cohesion adhesion": "write tv.PairForce(function, radius)",
        "mask filter pairs collision_filter": "write groups=[(0, 1)], pairs of the groups of tv.Particles(position, group=...)",
        "triggers is_sensor": "write sensors=[(0, 1)], pairs of groups",
        "force forces impulse load": "write world.contacts",
    },
    "Gravity": {
        "gravity acceleration strength magnitude value": "write g",
        "x y z direction vector down": "write tv.Gravity((0, -9.81)), or tv.Gravity(9.81) for that along -y",
    },
    "Drag": {"damping coefficient k c linear_damping viscosity": "write rate [1/s]"},
    "Wind": {"direction speed v": "write velocity", "drag coefficient strength": "write rate"},
    "Attractor": {"mass gm mu g": "write strength", "position pos point target": "write center"},
    "PairForce": {"cutoff r_cut rc range distance": "write radius", "force func f": "write function"},
    "Force": {"vector value": "write tv.Force(function), a function of the place; for a constant one tv.Gravity((0, -9.81))"},
    "init": {
        "device backend gpu platform": 'write arch="cuda"',
        "num_threads cpu_threads workers": "write threads=...",
        "precision dtype default_fp": 'write tv.World(particles, features, precision="f64")',
        "random_seed": "write seed=...",
    },
    "Recorder WorldsRecorder": {
        "filename file output": "write path",
        "fps frame_rate": "a frame is one world.step(dt); write every=...",
        "size width height camera theme": "films take it; write tv.replay(path).export(path, size=..., camera=..., theme=...)",
        "write record save add capture frame append": "write log()",
        "finish stop end": "write close()",
    },
    "Replay": {
        "save render to_mp4 video film write": 'write export("film.mp4")',
        "time": "write times",
        "positions states": "write position(frame)",
        "load state": "write world(frame)",
    },
    "StepReport": {
        "kinetic_energy": "write tv.measure.kinetic_energy(world)",
        "potential_energy total_energy": "write energy",
        "error max_error violation": "write residual",
        "converged ok success valid warnings": "write clean, flags and notes",
        "penetration depth": "write overlap",
        "elapsed wall_time duration dt": "write seconds, its run time; time is that of the scene",
        "t": "write time",
        "position velocity": "write world.position and world.velocity",
    },
    "Shape": {
        "points vertices nodes x positions": "write position",
        "edges pairs springs lines": "write links",
        "triples bending": "write bends",
        "triangles": "write faces",
        "tets cells": "write tetrahedra",
        "indices": "write links, bends, faces or tetrahedra",
        "mass": "write tv.Particles(position, mass=...)",
    },
    "Contacts": {
        "i j a b": "write pairs",
        "depth penetration distance": "write overlap",
        "force forces": "write impulse, and divide it by the substep",
        "position": "write point",
    },
    "Touches": {
        "i j a b": "write pairs",
        "force forces": "write impulse, and divide it by the frame's dt",
        "position": "write point",
        "start begin time": "write began and ended [s]",
        "velocity": "write speed",
    },
    "Hits": {
        "t fraction depth": "write distance",
        "position": "write point",
        "index body": "write particle, link or wall",
        "hit": "write met",
    },
    "rope chain cloth net": {"n count segments num_points resolution": "write points"},
}  # fmt: skip


def spelt(name: str) -> str:
    """Return a name without what differs between styles: case, underscores, and a get or set before it."""
    plain = name.lower()
    for word in ("get_", "set_"):
        plain = plain.removeprefix(word)
    if name[:3] in ("get", "set", "Get", "Set") and name[3:4].isupper():
        plain = plain[3:]
    return plain.replace("_", "")


TERMS: dict[str, dict[str, str]] = {}
for _owners, _rows in ROWS.items():
    for _owner in _owners.split():
        TERMS.setdefault(_owner, {}).update((spelt(name), clause) for names, clause in _rows.items() for name in names.split())
