"""Scenes under a mouse: the law of the hand, and requests of pages."""

import json
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.commands.play import load_world
from tiverlet.live import scene, session
from tiverlet.live.server import Server
from tiverlet.live.session import Session
from tiverlet.recording import surfaces
from tiverlet.recording.bodies import bodies

from .fuzz.oracles import gap

pytest.importorskip("websockets")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

pytestmark = pytest.mark.usefixtures("read_here")


def test_a_hand_is_a_critically_damped_spring_on_whom_it_holds(world):
    # x'' = -k^2 x - 2 k x' from x0 at rest: x0 (1 + k t) exp(-k t). Second order: half the substep gives a quarter of the error.
    hand = tv.Hand((0, 0), 1, rate=5.0)
    w = world(tv.Particles([[3.0, 0], [1.0, 2], [2.0, 2]]), [hand], precision="f64", substeps=8)
    exact, errors = 6 * np.exp(-5.0), []
    for substeps in (8, 16):
        w.substeps, w.velocity, w.position = substeps, np.zeros((3, 2)), w.particles.position
        w.run(1.0, dt=0.1)
        errors.append(np.abs(w.position[1] - exact * np.array([1.0, 2])).max())
    assert errors[0] < 1e-3 and errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    np.testing.assert_array_equal(w.position[[0, 2]], w.particles.position[[0, 2]])
    fields = w.fields
    hand.particle, hand.target = 2, (5, 5)  # another particle and place: nothing is rebuilt or compiled again
    w.run(3.0, dt=0.1)
    np.testing.assert_allclose(w.position[2], (5, 5), atol=1e-4)  # 3 (1 + 15) exp(-15) = 1e-5
    assert w.fields == fields and w.position[1, 1] < 0.1
    for wrong in (3, -2, 1.5):
        with pytest.raises((ValueError, TypeError), match="Hand: particle"):
            hand.particle = wrong
    with pytest.raises(ValueError, match="target"):
        hand.target = (0, np.nan)
    w.remove([0])
    assert hand.particle == 1
    w.remove([1])
    assert hand.particle == -1


@pytest.fixture
def server():
    made = Server()
    yield made
    made.close()


@pytest.fixture
def rope(world):
    line = tv.shapes.rope((0, 2), (1, 2), points=6)
    return world(tv.Particles(line.position, radius=0.02, pinned=[0]), [tv.Gravity(9.81), tv.Distance(line.links)], substeps=4)


def page(server, **options):
    options = {"origin": f"http://127.0.0.1:{server.port}", "compression": None} | options
    return connect(server.url.replace("http", "ws") + "socket", **options)


def hear(server, count: int) -> None:
    """Wait until `count` messages have arrived."""
    end = time.monotonic() + 10
    while server.received.qsize() < count and time.monotonic() < end:
        time.sleep(0.005)
    assert server.received.qsize() >= count


def refuse(name):
    raise AssertionError(f"{name} is no JSON")


def received(there) -> tuple[list[dict], dict, np.ndarray]:
    """Return the messages of a page up to the next frame, the figures of this frame, and its numbers. The page shows it."""
    said = []
    while isinstance(text := there.recv(timeout=10), str):
        said.append(json.loads(text, parse_constant=refuse))
    there.send('{"do": "shown"}')
    end = 4 + int.from_bytes(text[:4], "little")
    return said, json.loads(text[4:end], parse_constant=refuse), np.frombuffer(text[end:], "<f4")


@pytest.mark.slow
def test_what_pages_ask_for_is_done_recorded_and_replayed(rope, server, tmp_path):
    live = Session(rope, server, title="<rope>", record=tmp_path / "play.rrd")
    start = rope.hash()
    with page(server) as there:

        def turn(*messages) -> tuple[dict, np.ndarray]:
            for message in messages:
                there.send(json.dumps(message))
            hear(server, len(messages) + (not came))
            came.append(True)
            live.advance()
            new, told, x = received(there)
            said.extend(new)
            return told, x

        came, said = [], []
        told, x = turn()
        assert [m["kind"] for m in said] == ["scene", "walls"] and said[0]["title"] == "<rope>"
        assert said[0]["links"] == [[k, k + 1] for k in range(5)] and said[0]["pinned"] == [1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(x.reshape(6, 2), rope.position.astype(np.float32))
        assert told["time"] == pytest.approx(1 / 60) and "held" not in told
        told, x = turn({"do": "grab", "particle": 5, "target": [1.5, 2.5]})
        assert told["held"] == 5 and told["target"] == [1.5, 2.5]
        for _ in range(20):
            told, x = turn({"do": "move", "target": [0.5, 2.5]})
        assert x.reshape(6, 2)[5, 1] > 2.2  # the free end hangs above the pinned one
        told, _ = turn({"do": "drop"}, {"do": "slower"})
        assert "held" not in told and told["slower"] == 2
        before = rope.time
        turn()
        assert rope.time - before == pytest.approx(1 / 120)
        told, _ = turn({"do": "pause"})
        assert told["paused"] and rope.time == pytest.approx(before + 1 / 120)
        told, _ = turn({"do": "frame"}, {"do": "name", "particle": 0})
        assert rope.time == pytest.approx(before + 1 / 60) and "particle 0, pinned" in said[-1]["text"]
        assert "Distance" in said[-1]["text"]
        # Invalid requests are answered, and the scene continues.
        steps = live.steps
        for message in (
            {"do": "grab", "particle": 99, "target": [0, 0]}, {"do": "grab", "particle": 1}, {"do": "name", "particle": "x"},
            {"do": "grab", "particle": 1, "target": [0, float("inf")]}, {"do": "grab", "particle": 1, "target": "here"},
        ):  # fmt: skip
            turn(message)
            assert said[-1]["kind"] == "told" and live.hand.particle == -1
        turn({"do": "nothing"}, {"no": "thing"})
        assert live.steps == steps
        there.send("no JSON")
        with pytest.raises(ConnectionClosed):
            while True:
                there.recv(timeout=10)
    live.close()
    recording = tv.replay(tmp_path / "play.rrd")
    assert len(recording.frames) == live.steps + 1 and recording.verify().kind == "intact"
    # A restart returns to the start bit for bit, and the file begins there, too.
    live._restart()
    assert rope.time == 0.0 and rope.hash() == start
    live.paused = False
    live.advance()
    live.close()
    assert len(tv.replay(tmp_path / "play.rrd").frames) == 2


@pytest.mark.slow
def test_pages_let_go_when_they_go_and_only_of_what_they_hold_and_slow_ones_are_not_waited_for(rope, server, tmp_path):
    live = Session(rope, server)

    def ask(there, count, **message):
        there.send(json.dumps(message))
        hear(server, count)

    with page(server) as one, page(server) as other:
        hear(server, 2)
        ask(one, 3, do="grab", particle=4, target=[0, 0])
        ask(other, 4, do="grab", particle=5, target=[0, 0])
        ask(one, 5, do="drop")
        for _ in range(20):  # the pages never confirm a frame
            live.advance()
        assert live.hand.particle == 5 and live.steps == 20
        assert [viewer.waiting for viewer in server.viewers] == 2 * [session.AHEAD]
    hear(server, 2)
    live.advance()
    assert live.hand.particle == -1 and not server.viewers
    live.close()
    for name, words in (("notes.rrd", "is no recording, and is not replaced"), ("notes.txt", "ends in '.txt', but a recording")):
        (tmp_path / name).write_text("mine")
        with pytest.raises(ValueError, match=words):
            Session(rope, server, record=tmp_path / name)
        assert (tmp_path / name).read_text() == "mine" and not rope._watchers


def weight(world, g):
    """Return a world of a weight on a thread of 5 N and a disc that turns, and its features."""
    thread, lid, gravity = tv.Rope([[0, 1]], 1.0, break_at=5.0), tv.Box((-3, -3), (3, 3)), tv.Gravity(g)
    x = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]])
    particles = tv.Particles(x, radius=0.1, pinned=[0], spin=[0, 0, 2.0], orientation=0)
    return world(particles, [gravity, thread, lid], substeps=4), gravity, thread, lid


@pytest.mark.slow
def test_pages_are_told_what_breaks_moves_comes_and_turns(world, server):
    # m g = 9.8 N: the thread breaks at once. The lid moves while the page takes no frame.
    w, gravity, _, lid = weight(world, 0.0)
    live = Session(w, server)
    with page(server) as there:
        hear(server, 1)
        live.advance()
        said, told, numbers = received(there)
        assert {m["kind"]: m for m in said}["broken"]["links"] == [] and said[0]["turns"]
        np.testing.assert_allclose(numbers[6:], w.orientation, atol=1e-6)
        gravity.g = 9.81
        live.advance()
        said, _, _ = received(there)
        assert [m["kind"] for m in said] == ["broken"] and said[0]["links"] == [0]
        while server.viewers[0].waiting:  # the page has shown all
            time.sleep(0.005)
        for _ in range(session.AHEAD):
            live.advance()
        lid.upper = (3, 2)
        live.advance()  # not sent: the page has two frames to show
        live.advance()
        for _ in range(session.AHEAD):
            said, _, _ = received(there)
            assert not said
        while server.viewers[0].waiting:
            time.sleep(0.005)
        live.advance()
        said, _, _ = received(there)
        assert [m["kind"] for m in said] == ["walls"] and max(p[1] for s in said[0]["walls"][0]["strips"] for p in s) == 2
        w.add(tv.Particles([[1.0, 2.0]], radius=0.1, spin=[0.0], orientation=[0.0]))
        live.advance()
        said, _, numbers = received(there)
        assert len({m["kind"]: m for m in said}["scene"]["radius"]) == 4 and len(numbers) == 3 * 4
        there.send('{"do": "restart"}')
        hear(server, 1)
        live.advance()
        said, told, _ = received(there)
        assert "no way back" in said[0]["text"] and told["time"] > 0.05
    live.close()
    assert not w._watchers


@pytest.mark.slow
def test_a_restart_brings_back_knobs_and_what_broke(world, server):
    w, gravity, thread, lid = weight(world, 9.81)
    live = Session(w, server)
    start = w.hash()
    for _ in range(5):
        live.advance()
    then = w.hash()
    assert thread.broken.all()
    gravity.g, lid.upper = (1.0, 2.0), (3, 2)
    live.advance()
    live._restart()
    assert w.hash() == start and gravity.g == 9.81 and lid.upper[1] == 3 and not thread.broken.any()
    for _ in range(5):
        live.advance()
    assert w.hash() == then
    live.close()


def test_a_scene_that_diverges_is_still_shown(world, server):
    w = world(tv.Particles([[0.0, 0.0]], velocity=[[0.0, 1e160]]), [tv.Gravity(9.81)], precision="f64")  # v^2 is infinite
    live = Session(w, server)
    live.advance()
    assert not np.isfinite(w.last.energy)
    with page(server) as there:
        hear(server, 1)
        live.advance()
        _, told, _ = received(there)
        assert told["energy"] is None
    live.close()


def test_a_page_that_does_not_read_holds_up_nobody(server):
    with page(server, max_size=None, max_queue=1) as there:
        hear(server, 1)
        begin = time.monotonic()
        for _ in range(3):
            server.viewers[0].send(bytes(8 << 20))  # more than sockets buffer
        assert time.monotonic() - begin < 1
        assert [len(there.recv(timeout=10)) for _ in range(3)] == 3 * [8 << 20]


def test_only_who_knows_the_address_gets_in(server):
    with urllib.request.urlopen(server.url) as answer:
        assert b"<canvas" in answer.read() and "default-src 'none'" in answer.headers["Content-Security-Policy"]
    wrong = [("x" * 22, None), (server.token, "evil.example:80"), ("", None), (server.token + "x", None)]
    for token, host in wrong:
        request = urllib.request.Request(f"http://127.0.0.1:{server.port}/{token}/", headers={"Host": host} if host else {})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request)
    for name in ("session.py", "../server.py", "page.html", "%2e%2e/server.py"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(server.url + name)
    for origin in ("http://evil.example", None, f"http://127.0.0.1:{server.port + 1}", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            page(server, origin=origin)


def test_the_world_of_a_script_is_found(tmp_path, world):
    script = tmp_path / "s.py"
    start = "import tiverlet as tv\nw = lambda: tv.World(tv.Particles([[0.0, 0.0]]))\n"
    for text in ("build = lambda: (1, w())", "world = w()", "def play():\n    return w()\nbuild = None"):
        script.write_text(start + text)
        found, each_frame = load_world(str(script))
        assert isinstance(found, tv.World) and each_frame is None
        found.close()
    script.write_text("x = 1")
    with pytest.raises(ValueError, match="no world to play"):
        load_world(str(script))


def test_bodies_and_their_surfaces_are_found(world):
    # A loop around an area is filled, also where it is not convex: the areas of its triangles add up to the loop's area.
    star = np.array([[r * np.sin(t), r * np.cos(t)] for t, r in zip(np.arange(10) * np.pi / 5, [1.0, 0.4] * 5, strict=True)])
    x = np.concatenate([star, [[3, 0], [4, 0], [4, 1], [3, 1]], [[6, 0], [7, 0], [8, 0]]])
    features = [tv.Area([np.arange(10)]), tv.ShapeMatch([np.arange(10, 14)]), tv.Distance([(14, 15), (15, 16)])]
    w = world(tv.Particles(x), features)
    assert bodies(w).tolist() == [0] * 10 + [10] * 4 + [14] * 3
    corners = surfaces.triangles(w)
    areas = surfaces.doubled(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]]) / 2
    body = bodies(w)[corners[:, 0]]
    assert areas[body == 0].sum() == pytest.approx(w.features[0].rest[0]) and areas[body == 10].sum() == pytest.approx(1)
    assert set(body.tolist()) == {0, 10} and len(corners) == 8 + 2
    # A cube of six tetrahedra has twelve faces. A cloth with threads, diagonals, and braces over two threads has two triangles
    # per cell, none missing or doubled. A tetrahedron of links has four.
    cube = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)], dtype=float)
    tets = [[0, a, a + b, 7] for a, b in ((1, 2), (1, 4), (2, 1), (2, 4), (4, 1), (4, 2))]
    sheet = tv.shapes.cloth((5, 0, 0), (1, 0, 0), (0, 0, 1), (6, 5))
    edges = np.concatenate([8 + sheet.links, 8 + sheet.braces, 38 + np.stack(np.triu_indices(4, 1), axis=1)])
    x = np.concatenate([cube, sheet.position, np.eye(4, 3) + 9])
    corners = surfaces.triangles(world(tv.Particles(x), [tv.Volume(tets), tv.Distance(edges)]))
    areas = np.linalg.norm(np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]]), axis=1) / 2
    assert (corners < 8).all(axis=1).sum() == len(surfaces.surface_of(np.array(tets))) == 12
    flat = (corners >= 8).all(axis=1) & (corners < 38).all(axis=1)
    assert flat.sum() == 2 * 5 * 4 and areas[flat].sum() == pytest.approx(1.0) and (corners >= 38).all(axis=1).sum() == 4


def test_walls_have_surfaces_that_lie_on_them(world):
    walls = tv.Ball((1, 2, 3), 0.5), tv.Capsule((0, 0, 0), (0, 0, 2), 0.3), tv.HalfSpace((0, 1, 0), 0.25)
    world(tv.Particles(np.array([[0.0, 9, 0]])), walls)
    for wall in walls:
        vertices, faces = wall.solid(np.zeros(3), np.ones(3))
        np.testing.assert_allclose(gap(wall, vertices, np.zeros(len(vertices))), 0, atol=1e-12)
        assert faces.min() == 0 and faces.max() == len(vertices) - 1


def test_the_eye_stays_above_the_highest_floor():
    # The page gets its height: that of planes which face up and of boxes, switched on. A wall at the side is none.
    low, high = np.array([-1.0, 0, -1]), np.array([1.0, 2, 1])
    sunk, floor = tv.Box((-2, -0.5, -2), (2, 3, 2)), tv.HalfSpace((0, 1, 0), 0.25)
    for walls, height in (([], None), ([tv.HalfSpace((1, 0, 0), -1)], None), ([sunk], -0.5), ([sunk, floor], 0.25)):
        world = tv.World(tv.Particles(np.array([[0.0, 1, 0]])), [*(wall.copy() for wall in walls), tv.Gravity()])
        assert json.loads(scene.walls(world, (low, high)))["floor"] == height
    world.features[1].active = False
    assert json.loads(scene.walls(world, (low, high)))["floor"] == -0.5
    above = tv.World(tv.Particles(np.array([[0.0, 0, 1]])), [tv.Gravity((0, 0, -9.81)), tv.HalfSpace((0, 0, 1), -0.1)])
    assert json.loads(scene.walls(above, (low, high)))["floor"] == pytest.approx(-0.1)
