"""The loops over contacts: they detect and solve contacts, and store what the next substep needs."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..device.number import OnDevice
from ..device.thread_team import block, blocks
from .row_pass import RowPass

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .particle_pass import ParticlePass


class ContactPass:
    """The contacts of one world, if it has any. Pairs are solved particle by particle."""

    n: Any = OnDevice()  # particles

    def __init__(self, scene: "Scene", contact: Any, particles: "ParticlePass", team: "Team"):
        self.contacts, self.particles, self.team = particles.contacts, particles, team
        self.impacts: Any = scene.impacts
        self.n, self.real, self.dim = scene.count, scene.real, scene.particles.dim
        self.rows: Any = RowPass(scene, contact, particles, team) if contact and contact.dev.rows else None
        self.has_restitution = bool(contact) and contact.has_restitution and not contact.solves_rows
        keeps = contact and (contact.has_friction or contact.has_restitution or contact.has_events or contact.has_loads)
        self.remembers = bool(contact and contact.has_events if self.rows else keeps)
        self.projects_bodies = bool(contact and contact.dev.bodies)
        if self.has_restitution and team.launched:  # the host does not read whether any pair bounces in a round
            self.bounces = scene.memory.field("Contact.bounces", None, kind=ti.i32)

    @ti.func
    def solve(self, now):
        """Detect contacts, and compute the moves that they want of their particles."""
        for c in ti.static(self.contacts):
            if ti.static(c.detects and not c.dev.state.sleepers):  # with Sleep, Step.look_for_sleepers() has done this
                self.detect(c, now)
            if ti.static(c.dev.has_events):
                self.start_events(now)
            if ti.static(bool(c.dev.rows)):
                if now.first != 0:
                    self.rows.solve(now)
            else:
                self.count(c, now)
                self.relax(c, now)
            if ti.static(c.has_loads):
                self.store_pushes(c, now)

    @ti.func
    def detect(self, c: ti.template(), now):  # type: ignore[valid-type]
        """Find the contacts of all particles."""
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            c.detect(i, now.first)
        self.team.wait()

    @ti.func
    def count(self, c: ti.template(), now):  # type: ignore[valid-type]
        """Count the contacts of each particle, among which its mass is split."""
        for k in range(self.particles.piece_count(now.thread)):
            begin, end = self.particles.piece(k, now.thread)
            for b in range(blocks(begin, end)):
                low, high = block(b, begin, end)
                c.count(low, high, now)
        self.team.wait()

    @ti.func
    def relax(self, c: ti.template(), now):  # type: ignore[valid-type]
        """Compute the moves of all particles, and the new pushes of their contacts."""
        for k in range(self.particles.piece_count(now.thread)):
            begin, end = self.particles.piece(k, now.thread)
            for i in range(begin, end):
                if c.dev.state.awake(i):
                    c.relax(i, now)
        self.team.wait()

    @ti.func
    def store_pushes(self, c: ti.template(), now):  # type: ignore[valid-type]
        """Store the pushes of contacts that one particle stores, after all particles have read them."""
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            if c.dev.state.awake(i):
                c.store_pushes(i, now)

    @ti.func
    def struck(self):
        """Return 1 if a pair bounces in this substep, else 0."""
        out = 0
        for c in ti.static(self.contacts):
            if ti.static(c.has_restitution):
                out = c.dev.hit[None]
        return out

    @ti.func
    def rebound(self, thread):
        """Do one round of restitution. struck() returns whether another one is needed."""
        for c in ti.static(self.contacts):
            if ti.static(c.has_restitution):
                self.team.wait()
                ti.loop_config(serialize=True)
                for _ in range(self.team.one(1, thread)):
                    if ti.static(self.team.launched):
                        self.bounces[None] = c.dev.hit[None]
                    c.dev.hit[None] = 0
                self.team.wait()
                n = self.n
                if ti.static(self.team.launched):
                    n *= self.bounces[None]
                for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    if c.dev.state.awake(i):
                        c.dev.restitution.choose(i)
                self.team.wait()
                for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    if c.dev.state.awake(i):
                        c.dev.restitution.apply(i)
                self.team.wait()

    @ti.func
    def push_bodies(self, now):
        """In extra passes: push the particles of bodies that struck each other, see BodyImpacts."""
        for c in ti.static(self.contacts):
            if ti.static(c.has_restitution and c.strikes_bodies):
                for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                    if c.dev.state.awake(i):
                        if c.dev.restitution.push_body(i, now):
                            self.impacts.request_pass(now)
                self.team.wait()
                for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                    if c.dev.state.awake(i):
                        c.dev.restitution.apply_push(i)
                self.team.wait()

    @ti.func
    def begin_events(self, now):
        """Begin the events of a pass, if there are any."""
        for c in ti.static(self.contacts):
            if ti.static(c.dev.has_events):
                self.start_events(now)

    @ti.func
    def start_events(self, now):
        """Record the number of the substep, and at the start of a frame the pairs that touched before."""
        for c in ti.static(self.contacts):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                c.dev.events.start(now.s, now.first)
            self.team.wait()
            # A loop in a branch would be serial on a GPU.
            pieces = self.particles.pieces * ti.cast(now.s == 0 and now.first != 0, ti.i32)
            for k in range(self.team.dealt_count(pieces, 1, now.thread)):
                begin, end = self.particles.piece(k, now.thread)
                c.dev.events.open(begin, end)

    @ti.func
    def finish_events(self, now):
        """Record what sensors overlap, and at the end of a frame the pairs that touch."""
        for c in ti.static(self.contacts):
            if ti.static(c.dev.events.senses):
                for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                    c.dev.events.sense(i, now.final)
            n = self.n * now.final
            for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                c.dev.events.close(i)

    @ti.func
    def finish(self, now):
        """Store the slip of friction and the slack of restitution, and log events."""
        thread = now.thread
        for c in ti.static(self.contacts):
            if ti.static(not c.dev.rows and (c.has_friction or c.has_restitution or c.has_loads)):
                for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
                    if c.dev.state.awake(i):
                        c.finish_substep(i, now)
            if ti.static(c.dev.has_events):
                self.finish_events(now)
            self.team.wait()
            if ti.static(self.has_restitution):
                ti.loop_config(serialize=True)
                for _ in range(self.team.one(1, thread)):
                    c.dev.hit[None] = 0

    @ti.func
    def has_struck_bodies(self):
        """Whether bodies struck each other in this substep."""
        out = False
        for c in ti.static(self.contacts):
            out = c.dev.bodies.any_struck[None] != 0
        return out

    @ti.func
    def body_rounds(self):
        """Return how many rounds find the impacts of bodies: two to begin, one for each pass, and one to end."""
        out = 0
        for c in ti.static(self.contacts):
            out = c.dev.bodies.passes + 3
        return out

    @ti.func
    def project_bodies(self, thread, k, tick):
        """Do round k of the impacts of bodies in substep `tick`, see BodyProjection."""
        for c in ti.static(self.contacts):
            begin, end = self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)
            for i in range(begin, end):
                if k == 0:
                    c.dev.bodies.begin(i, c.dev.geometry, tick + 1)
                elif k == 1:
                    c.dev.bodies.list_contacts(i, c.dev.geometry, tick + 1)
                elif k < c.dev.bodies.passes + 2:
                    c.dev.bodies.press(i, k - 2, c.dev.geometry, tick + 1)
                elif c.dev.bodies.end(i, c.dev.geometry):
                    c.note_motion(c.dev.search.moved_too_far(i), 0)
            self.team.wait()
            for i in range(begin, end):
                if k == 0:
                    c.dev.bodies.begin_body(i)
                elif k > 1 and k < c.dev.bodies.passes + 2:
                    c.dev.bodies.follow(i, c.dev.geometry)
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(ti.cast(k == 0, ti.i32), thread)):
                c.dev.bodies.any_struck[None] = 0
            self.team.wait()
