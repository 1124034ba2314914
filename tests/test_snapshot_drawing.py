"""Snapshots of environments that draw: windows are no state, what games keep in pygame's classes is."""

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError
from sb3_mcbs.snapshot.handlers import handler_of
from tests.test_snapshot_graph import Small, follow, wrapped
from tests.test_snapshot_kinds import assert_same_future

pygame = pytest.importorskip("pygame")


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.quit()


class Player(pygame.Rect):
    """Pygame's own pickles forget the attributes of such an object."""

    def __init__(self, lives):
        super().__init__(lives, 0, 4, 4)
        self.lives = [lives]


class Ball(pygame.sprite.Sprite):
    def __init__(self, *groups):
        super().__init__(*groups)
        self.image = pygame.Surface((4, 4))
        self.rect = self.image.get_rect()


class Values(Small):
    def prepare(self):
        self.player, self.place = Player(3), pygame.Rect(0, 0, 2, 2)
        self.speed, self.spin = pygame.Vector2(1, 0), pygame.Vector3(0, 0, 1)
        self.speed.epsilon = 0.5
        self.color, self.mask = pygame.Color(1, 2, 3), pygame.Mask((70, 3))
        self.event = pygame.event.Event(pygame.USEREVENT, hits=[0])
        self.same = self.event

    def advance(self):
        self.speed.x += 1
        self.spin.rotate_ip(30, (1, 0, 0))
        self.place.move_ip(self.speed)
        self.player.lives[0] += 1
        self.player.x += self.player.lives[0]
        self.color.r = (self.color.r + 1) % 255
        self.event.hits[0] += 1
        self.mask.set_at((self.same.hits[0] % 70, 2))
        sums = self.player.x + self.place.x + self.spin.y + self.color.r + self.mask.count()
        return sums + self.event.hits[0] + (self.speed == self.speed + pygame.Vector2(0.4, 0))


class Sprites(Small):
    def prepare(self):
        self.balls, self.only = pygame.sprite.Group(), pygame.sprite.GroupSingle()
        self.layers = pygame.sprite.LayeredUpdates()
        self.first = Ball(self.balls, self.only)
        self.layers.add(self.first, layer=2)

    def advance(self):
        self.only.sprite.rect.x += 1
        self.layers.add(Ball(self.balls), layer=1)
        if len(self.balls) > 4:
            self.balls.sprites()[-1].kill()
        self.only.add(self.balls.sprites()[-1])
        at = [self.layers.get_layer_of_sprite(ball) * ball.rect.x for ball in self.layers]
        return float(sum(at) + len(self.balls) + 10 * len(self.layers) + self.first.alive())


class Painting(Small):
    """Reads its observation from what it has drawn."""

    def prepare(self):
        self.world = pygame.Surface((8, 6), pygame.SRCALPHA)
        self.part = self.world.subsurface((2, 2, 4, 4))
        self.plain, self.indexed = pygame.Surface((8, 6)), pygame.Surface((8, 6), 0, 8)
        self.indexed.set_palette([(n, 0, 0) for n in range(256)])
        self.pictures = [pygame.Surface((2, 2)) for _ in range(3)]
        for n, picture in enumerate(self.pictures):
            picture.fill((n, 1, 1))
        self.picture = self.pictures[0]

    def advance(self):
        n = int(self.total) % 50
        self.part.set_at((n % 4, 1), (n, 2, 3, n))
        self.plain.set_alpha(n + 1)
        self.plain.set_colorkey((n, n, n))
        self.plain.blit(self.world, (1, 1))
        self.indexed.set_at((n % 8, 1), n)
        self.picture = self.pictures[(self.pictures.index(self.picture) + 1) % 3]
        seen = [pygame.surfarray.array3d(surface).sum() for surface in (self.world, self.plain, self.indexed)]
        return float(
            sum(seen) + self.plain.get_alpha() + self.plain.get_colorkey()[0] + self.picture.get_at((0, 0))[0]
        )


class Picture(Small):
    def prepare(self):
        self.image = Image.new("L", (4, 4))

    def advance(self):
        self.image.putpixel((1, 1), self.image.getpixel((1, 1)) + 1)
        return float(np.asarray(self.image).sum())


@pytest.mark.parametrize("cls", [Values, Sprites, Painting, Picture])
def test_values_of_packages_that_draw(cls):
    assert_same_future(cls)


def test_pictures_that_nobody_drew_on_stay():
    env = wrapped(Painting)
    painting = env.unwrapped
    state, kept, drawn = env.snapshot(), list(painting.pictures), painting.world
    follow(env, 2)
    env.restore(state)
    assert all(one is other for one, other in zip(painting.pictures, kept, strict=True))
    assert painting.world is not drawn and painting.part.get_parent() is painting.world
    clone = env.clone().unwrapped
    assert clone.picture is clone.pictures[painting.pictures.index(painting.picture)] is not painting.picture


class Showing(Small):
    """Draws on a display from its first step on."""

    def prepare(self):
        pygame.font.init()
        self.screen, self.clock, self.font = None, pygame.time.Clock(), pygame.font.Font(None, 8)

    def advance(self):
        self.clock.tick()
        return float(self.font.size("text")[0])

    def render(self):
        if self.screen is None:
            pygame.display.init()
            self.screen = pygame.display.set_mode((8, 8))
            self.corner = self.screen.subsurface((0, 0, 2, 2))

    def close(self):
        pygame.quit()


def test_displays_clocks_and_fonts_are_no_state():
    env = wrapped(Showing)
    state = env.snapshot()
    env.render()
    screen, corner = env.unwrapped.screen, env.unwrapped.corner
    env.restore(state)
    assert env.unwrapped.screen is screen and env.unwrapped.corner is corner
    expected, clone = follow(env, 3), env.clone()
    assert clone.unwrapped.screen is None and clone.unwrapped.font is env.unwrapped.font
    env.restore(env.snapshot())
    clone.restore(state)
    assert follow(clone, 3) == expected and env.unwrapped.screen is screen
    clone.close()
    assert pygame.display.get_surface() is screen and pygame.font.get_init(), "it has no window to close"


@pytest.mark.parametrize("render_mode", ["rgb_array", "human"])
@pytest.mark.parametrize("name", ["Pendulum-v1", "MountainCarContinuous-v0", "BipedalWalker-v3"])
@pytest.mark.filterwarnings("ignore:The simulator of BipedalWalker")
def test_rendering_of_known_environments(name, render_mode):
    env = SnapshotEnvWrapper(gym.make(name, render_mode=render_mode))
    env.unwrapped.metadata = {**env.unwrapped.metadata, "render_fps": 10**6}
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(3)]

    def steps(target):
        return [target.step(action)[0].tobytes() for action in actions]

    before = env.snapshot()
    expected = steps(env)
    env.render()
    surface = env.unwrapped.surf
    assert isinstance(surface, pygame.Surface)
    state, clone = env.snapshot(), env.clone()
    assert not any(kind == "surface" for kind, _ in state.nodes), "that would be a megabyte each"
    assert clone.unwrapped.screen is None and getattr(clone.unwrapped, "surf", None) is None
    for target in (env, clone):
        target.restore(before)
        assert steps(target) == expected
    assert isinstance(env.unwrapped.surf, pygame.Surface)
    clone.close()
    frame = env.render()
    assert (frame is None) == (render_mode == "human")
    env.close()


@pytest.mark.parametrize(
    "make", [pygame.PixelArray, pygame.surfarray.pixels3d, lambda surface: surface.get_buffer()]
)
def test_what_is_refused(make):
    env = Small()
    env.thing = make(pygame.Surface((2, 2)))
    with pytest.raises(SnapshotUnsupportedError, match=r"Small\.thing cannot be part of a snapshot.*pygame"):
        SnapshotEnvWrapper(env)


def fake(name):
    """Make an object of a class with the name of one of a package that need not be here."""
    module, _, qualname = name.rpartition(".")
    return type(qualname, (), {"__module__": module})()


@pytest.mark.parametrize(
    "kind, names",
    [
        ("window", ["pyglet.window.xlib.XlibWindow", "pyglet.graphics.Batch", "pyglet.gl.base.Config"]),
        ("window", ["tkinter.Canvas", "glfw._GLFWwindow", "OpenGL.arrays.vbo.VBO", "mujoco.viewer.Handle"]),
        ("constant", ["pyglet.clock.Clock", "pygame.mixer.Sound"]),
        ("drawn", ["pyglet.shapes.Circle", "pyglet.text.Label", "pyglet.sprite.Sprite"]),
        ("object", ["pyglet.math.Mat4", "pyglet.image.ImageData", "OpenGL.constant.Constant"]),
    ],
)  # fmt: skip
def test_windows_of_other_packages(kind, names):
    for name in names:
        assert handler_of(fake(name)).name == kind, name


def test_what_is_drawn_in_a_window_is_refused():
    env = Small()
    env.ball = fake("pyglet.shapes.Circle")
    with pytest.raises(
        SnapshotUnsupportedError, match=r"Small\.ball .*pyglet\.shapes\.Circle keeps its place"
    ):
        SnapshotEnvWrapper(env)


class Plot(Small):
    def prepare(self):
        self.figure = Figure()
        self.axes = self.figure.subplots()
        (self.line,) = self.axes.plot([0, 1])


def test_figures_are_no_state():
    env = wrapped(Plot)
    figure, state = env.unwrapped.figure, env.snapshot()
    assert len(state.nodes) < 10
    env.restore(state)
    assert env.unwrapped.figure is figure and env.clone().unwrapped.line is None


class OtherRows(Small):
    """Rows of these pictures lie farther apart, or less far, than those of a picture that pygame makes."""

    def prepare(self):
        pygame.font.init()
        self.bytes = pygame.image.frombuffer(bytearray(i * 7 % 256 for i in range(75)), (5, 5), "RGB")
        self.text = pygame.font.Font(None, 14).render("Score 0", True, (255, 255, 255))

    def advance(self):
        self.bytes.set_at((4, 4), ((self.bytes.get_at((4, 4))[0] + 1) % 250, 1, 2))
        pixels = pygame.surfarray.array3d(self.bytes), pygame.surfarray.array3d(self.text)
        return float(sum((part * np.arange(part.size).reshape(part.shape)).sum() % 9973 for part in pixels))


def test_rows_of_pixels_may_lie_anywhere_in_memory():
    env, clone = assert_same_future(OtherRows)
    for name in ("bytes", "text"):
        pictures = [getattr(each.unwrapped, name) for each in (env, clone)]
        np.testing.assert_array_equal(*map(pygame.surfarray.array3d, pictures), err_msg=name)
