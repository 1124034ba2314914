"""Environments that simulate with PyBullet: what users bring, and what they get wrong."""

import functools

import gymnasium as gym
import numpy as np
import pybullet as p


class Ball(gym.Env):
    """A ball that falls on the ground: an integer is all that it knows of its world."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self):
        self.client = p.connect(p.DIRECT)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        p.resetSimulation(physicsClientId=self.client)
        p.setGravity(0, 0, -10, physicsClientId=self.client)
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client)
        p.createMultiBody(0, plane, physicsClientId=self.client)
        self.load()
        return self.observe(), {}

    def load(self):
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1, physicsClientId=self.client)
        height = self.np_random.uniform(0.15, 0.3)
        self.ball = p.createMultiBody(1, shape, basePosition=[0, 0, height], physicsClientId=self.client)

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.ball, physicsClientId=self.client)
        speed, _ = p.getBaseVelocity(self.ball, physicsClientId=self.client)
        return np.array([place[2], speed[2]], np.float32)

    def push(self, action):
        force = [0, 0, float(action[0]) * 20]
        p.applyExternalForce(self.ball, -1, force, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.client)

    def step(self, action):
        self.push(action)
        p.stepSimulation(physicsClientId=self.client)
        return self.observe(), 0.0, False, False, {}


class LazyBall(Ball):
    """Connects in its first reset, and disconnects when it is closed."""

    def __init__(self):
        self.client = None

    def reset(self, *, seed=None, options=None):
        if self.client is None:
            self.client = p.connect(p.DIRECT)
        return super().reset(seed=seed)

    def close(self):
        if self.client is not None:
            p.disconnect(self.client)
            self.client = None


class ReconnectingBall(LazyBall):
    """Has another server in each episode."""

    def reset(self, *, seed=None, options=None):
        self.close()
        return super().reset(seed=seed)


class Gripper:
    def __init__(self, client):
        self.client_id = client


class NestedBall(Ball):
    """Its handle is in objects, dictionaries and functions, too."""

    def __init__(self):
        super().__init__()
        self.gripper = Gripper(self.client)
        self.arguments = {"physicsClientId": self.client}
        self.simulate = functools.partial(p.stepSimulation, physicsClientId=self.client)
        client = self.client
        self.count = lambda: p.getNumBodies(physicsClientId=client)

    def step(self, action):
        p.applyExternalForce(
            self.ball, -1, [0, 0, float(action[0])], [0, 0, 0], p.LINK_FRAME, **self.arguments
        )
        self.simulate()
        observation = self.observe()
        return observation, p.getNumBodies(self.gripper.client_id) + self.count(), False, False, {}


class LoadedBall(Ball):
    """Loads its bodies in the constructor, and says what gravity is in every step."""

    def __init__(self):
        super().__init__()
        super().reset(seed=0)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        place = [0, 0, self.np_random.uniform(0.15, 0.3)]
        p.resetBasePositionAndOrientation(self.ball, place, [0, 0, 0, 1], physicsClientId=self.client)
        p.resetBaseVelocity(self.ball, [0, 0, 0], [0, 0, 0], physicsClientId=self.client)
        return self.observe(), {}

    def step(self, action):
        result = super().step(action)
        p.setGravity(0, 0, -10 + float(action[0]), physicsClientId=self.client)
        return result


class HeavyBall(Ball):
    """Changes a mass in its steps, which PyBullet does not save."""

    def step(self, action):
        p.changeDynamics(self.ball, -1, mass=1 + float(action[0]) ** 2, physicsClientId=self.client)
        return super().step(action)


class Pile(Ball):
    """Bodies that lean on each other: the caches of the collision detection count."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (24,))

    def load(self):
        client = self.client
        for place in ((0.4, 0), (-0.4, 0), (0, 0.4), (0, -0.4)):
            size = [0.2 if place[0] else 0.6, 0.2 if place[1] else 0.6, 1]
            wall = p.createCollisionShape(p.GEOM_BOX, halfExtents=size, physicsClientId=client)
            p.createMultiBody(0, wall, basePosition=[*place, 0], physicsClientId=client)
        box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.05, 0.06, 0.04], physicsClientId=client)
        can = p.createCollisionShape(p.GEOM_CYLINDER, radius=0.05, height=0.1, physicsClientId=client)
        pill = p.createCollisionShape(p.GEOM_CAPSULE, radius=0.04, height=0.1, physicsClientId=client)
        self.bodies = [
            p.createMultiBody(
                1,
                (box, can, pill)[number % 3],
                basePosition=[*self.np_random.uniform(-0.1, 0.1, 2), 0.06 + 0.1 * number],
                baseOrientation=[0.3 * number, 0.1, 0, 1],
                physicsClientId=client,
            )
            for number in range(8)
        ]
        self.ball = self.bodies[0]

    def observe(self):
        places = [p.getBasePositionAndOrientation(b, physicsClientId=self.client)[0] for b in self.bodies]
        return np.concatenate(places).astype(np.float32)


class ForgetfulPile(Pile):
    """Never starts a new world, so that not even its episodes repeat themselves."""

    def reset(self, *, seed=None, options=None):
        if "bodies" not in vars(self):
            super().reset(seed=seed)
        gym.Env.reset(self, seed=seed)
        for number, body in enumerate(self.bodies):
            p.resetBasePositionAndOrientation(
                body, [0, 0, 0.06 + 0.1 * number], [0.3 * number, 0.1, 0, 1], physicsClientId=self.client
            )
        return self.observe(), {}


class GivenBall(Ball):
    """Is given its server."""

    def __init__(self, server):
        self.client = server


class WorldBall(Ball):
    """Its handle has a name of its own."""

    def __init__(self):
        self.world = p.connect(p.DIRECT)

    @property
    def client(self):
        return self.world


class DefaultBall(Ball):
    """Says nowhere which server it means: PyBullet takes the first."""

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.ball)
        return np.array([place[2], p.getBaseVelocity(self.ball)[0][2]], np.float32)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        p.resetSimulation()
        p.setGravity(0, 0, -10)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1)
        self.ball = p.createMultiBody(1, shape, basePosition=[0, 0, self.np_random.uniform(0.5, 1)])
        return self.observe(), {}

    def step(self, action):
        p.applyExternalForce(self.ball, -1, [0, 0, float(action[0])], [0, 0, 0], p.LINK_FRAME)
        p.stepSimulation()
        return self.observe(), 0.0, False, False, {}


class WindowBall(Ball):
    mode = p.DIRECT

    def __init__(self):
        self.client = p.connect(self.mode)
