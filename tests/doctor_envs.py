"""Environments for the doctor, some of them ill. The tests give it this file, and RL Zoo the module."""

import ctypes
import os
import random

import gymnasium as gym
import numpy as np


class Ball(gym.Env):
    """A ball that actions push; its dynamics are deterministic."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_fps": 20}  # noqa: RUF012

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.place.astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        self.place = 0.9 * self.place + 0.1 * float(action[0])
        cost = float(self.place @ self.place)
        return self.place.astype(np.float32), -cost, False, self.steps >= 20, {}


class Windy(Ball):
    """It draws from its own generator."""

    def step(self, action):
        self.place = self.place + self.np_random.normal(size=2)
        return super().step(action)


class Forgetful(Ball):
    """Its rewards are random numbers that no seed decides."""

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, random.SystemRandom().random(), *rest


class Robot(Ball):
    """It holds what cannot be captured."""

    def __init__(self):
        self.connection = (signal for signal in (1, 2))


class Discrete(Ball):
    action_space = gym.spaces.Discrete(3)


class Unbounded(Ball):
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


class Broken(Ball):
    def step(self, action):
        raise KeyError("joint_7")


class Hanging(Ball):
    def step(self, action):
        while self.steps == 5:
            pass
        return super().step(action)


class Crashing(Ball):
    def step(self, action):
        ctypes.string_at(0)


class Exiting(Ball):
    def step(self, action):
        print("the robot is gone", flush=True)
        os._exit(0)


class Mirror(gym.ObservationWrapper):
    def observation(self, observation):
        return -observation


def nothing():
    return None


for _cls in (Ball, Forgetful):
    if f"{_cls.__name__}-v0" not in gym.registry:
        gym.register(f"{_cls.__name__}-v0", entry_point=_cls)
