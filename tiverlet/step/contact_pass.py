"""Contacts in a substep: they are solved as rows, and told in events."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..device.number import OnDevice
from .row_pass import RowPass

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .particle_pass import ParticlePass


class ContactPass:
    """The contacts of one world, if it has any."""

    n: Any = OnDevice()  # particles

    def __init__(self, scene: "Scene", contact: Any, particles: "ParticlePass", team: "Team"):
        self.contacts, self.particles, self.team, self.n = particles.contacts, particles, team, scene.count
        self.rows: Any = RowPass(scene, contact, particles, team) if contact else None
        self.remembers = bool(contact and contact.has_events)

    @ti.func
    def solve(self, now):
        """Solve contacts, in the first pass of a substep."""
        self.begin_events(now)
        if ti.static(bool(self.rows)):
            if now.first != 0:
                self.rows.solve(now)

    @ti.func
    def begin_events(self, now):
        """If there are events: record the number of the substep, and at the start of a frame the pairs that touched before."""
        for c in ti.static([c for c in self.contacts if c.dev.has_events]):
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
        """Log events at the end of a substep."""
        for c in ti.static(self.contacts):
            if ti.static(c.dev.has_events):
                self.finish_events(now)
            self.team.wait()
