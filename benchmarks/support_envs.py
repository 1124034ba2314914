"""Environments of the support table that an id alone does not make: the doctor gets ``FILE:FUNCTION``."""

import importlib
import tempfile
from functools import partial
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

#: An arm that a mocap body pulls, with an actuator that has state, and three sensors.
PULLED_ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="guide" mocap="true" pos="0.4 0 0.5"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="shoulder" axis="0 1 0" damping="1"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
      <body name="hand" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.5"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/>
        <site name="tip" pos="0.2 0 0"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="hand" body2="guide" anchor="0 0 0" solref="0.1 1"/></equality>
  <actuator>
    <general joint="elbow" dyntype="filter" dynprm="0.1" gainprm="5" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
  <sensor>
    <jointpos joint="shoulder"/>
    <jointvel joint="elbow"/>
    <accelerometer site="tip"/>
  </sensor>
</mujoco>
"""


class PulledArm(MujocoEnv):
    """Own XML: one action moves a mocap body up and down, the other drives an actuator with state."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012

    def __init__(self, xml_file: str) -> None:
        size = 2 + 2 + 1 + 5 + 3
        super().__init__(xml_file, 4, gym.spaces.Box(-np.inf, np.inf, (size,), np.float64))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _observe(self) -> np.ndarray:
        data = self.data
        return np.concatenate([data.qpos, data.qvel, data.act, data.sensordata, data.mocap_pos[0]])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.float64, bool, bool, dict[str, np.float64]]:
        """Move the guide, then simulate.

        :param action: speed of the guide, and the actuator's control.
        """
        self.data.mocap_pos[0, 2] = np.clip(self.data.mocap_pos[0, 2] + 0.01 * action[0], 0.3, 0.7)
        self.do_simulation(action[1:], self.frame_skip)
        reward = -np.abs(self.data.site("tip").xpos[2] - 0.6)
        return self._observe(), reward, False, False, {}

    def reset_model(self) -> np.ndarray:
        """Start near the middle."""
        self.data.mocap_pos[0] = (0.4, 0, 0.5)
        self.set_state(self.init_qpos + self.np_random.uniform(-0.05, 0.05, 2), self.init_qvel)
        return self._observe()


class Drone(gym.Env):
    """Pure Python: a drone in a plane, with its position kept in a list and its wind in an object."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Start somewhere.

        :param seed: of the place.
        :param options: not used.
        """
        super().reset(seed=seed)
        self.path = [self.np_random.uniform(-1, 1, 2)]
        self.velocity = np.zeros(2)
        return self._observe(), {}

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.path[-1], self.velocity]).astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Accelerate.

        :param action: the acceleration.
        """
        self.velocity = 0.95 * self.velocity + 0.05 * np.asarray(action, dtype=float)
        self.path.append(self.path[-1] + self.velocity)
        return self._observe(), -float(np.linalg.norm(self.path[-1])), False, len(self.path) > 200, {}


def pulled_arm() -> gym.Env:
    """An environment with XML of its own."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(PULLED_ARM)
        file.flush()
        return gym.wrappers.TimeLimit(PulledArm(file.name), 200)


def fetch_reach() -> gym.Env:
    """Fetch without an object."""
    return _robot("FetchReach-v4")


def fetch_push() -> gym.Env:
    """Fetch with an object."""
    return _robot("FetchPush-v4")


def hand_reach() -> gym.Env:
    """The Shadow hand."""
    return _robot("HandReach-v3")


def _robot(env_id: str) -> gym.Env:
    """gymnasium-robotics 1.4.2 looks for NumPy's integers among MuJoCo's enumerations, which MuJoCo 3.17 does
    not find equal any more: it cannot read or set a joint."""
    utils = importlib.import_module("gymnasium_robotics.utils.mujoco_utils")

    def read(model: Any, data: Any, name: str, field: str) -> np.ndarray:
        return getattr(data.joint(name), field).copy()

    def write(model: Any, data: Any, name: str, value: np.ndarray, field: str) -> None:
        setattr(data.joint(name), field, value)

    for field in ("qpos", "qvel"):
        setattr(utils, f"get_joint_{field}", partial(read, field=field))
        setattr(utils, f"set_joint_{field}", partial(write, field=field))
    return gym.make(f"gymnasium_robotics:{env_id}")


def meta_world() -> gym.Env:
    """MetaWorld 3 writes the 11 numbers that a weld had before MuJoCo 3.17, which has 12."""
    sawyer = importlib.import_module("metaworld.sawyer_xyz_env")

    def reset_mocap_welds(self: Any) -> None:
        welds = self.model.eq_type == mujoco.mjtEq.mjEQ_WELD
        self.model.eq_data[welds, :11] = (0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5)

    sawyer.SawyerMocapBase.reset_mocap_welds = reset_mocap_welds
    return gym.make("Meta-World/MT1", env_name="reach-v3", seed=0)


def drone() -> gym.Env:
    """An environment without a simulator."""
    return Drone()
