"""The batch model gives what Gymnasium's MuJoCo environments give, bit for bit."""

import re
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.ant_v5 import AntEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

from sb3_mcbs.models import (
    Family,
    ForwardModelError,
    LocalEnvironments,
    MujocoBatchModel,
    families,
    make_forward_model,
    register_family,
    row_arithmetic,
)
from sb3_mcbs.models.compiling import JIT_IS_OFF, fingerprint
from sb3_mcbs.models.families import known_families
from sb3_mcbs.models.row_arithmetic import (
    norm,
    numpy_sum,
    scalar_power,
    sum_of_squares,
    weighted_squares,
    widens,
)
from sb3_mcbs.snapshot import SnapshotEnvWrapper

DOCUMENT = Path(__file__).parents[1] / "docs" / "forward_models.md"

REGISTERED = [
    env_id
    for env_id, spec in gym.registry.items()
    if isinstance(spec.entry_point, str) and spec.entry_point.startswith("gymnasium.envs.mujoco.")
]
# It refuses every MuJoCo that has a batch.
CONSTRUCTIBLE = [env_id for env_id in REGISTERED if env_id != "Pusher-v4"]

INCLUDES = [f"include_{name}_in_observation" for name in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")]
NOTHING_INCLUDED = dict.fromkeys(INCLUDES, False)
WITH_POSITIONS = {"exclude_current_positions_from_observation": False}
UNHEALTHY = {"terminate_when_unhealthy": False, "healthy_reward": 3}

VARIATIONS = [
    ("HalfCheetah-v4", {**WITH_POSITIONS, "ctrl_cost_weight": 0.3, "forward_reward_weight": 2}),
    ("HalfCheetah-v5", {**WITH_POSITIONS, "frame_skip": 3, "ctrl_cost_weight": np.float64(0.7)}),
    ("HalfCheetah-v5", {"xml_file": "walker2d.xml", "forward_reward_weight": 0.25, "reset_noise_scale": 0.3}),
    ("Swimmer-v4", {**WITH_POSITIONS, "ctrl_cost_weight": 0.1}),
    ("Swimmer-v5", {**WITH_POSITIONS, "frame_skip": 1, "forward_reward_weight": -1.5}),
    ("Hopper-v4", {**WITH_POSITIONS, **UNHEALTHY, "healthy_z_range": (1.2, 1.3)}),
    ("Hopper-v5", {**UNHEALTHY, "healthy_state_range": (-1, 1), "healthy_angle_range": (-0.01, 0.02)}),
    ("Hopper-v5", {"healthy_state_range": (-2.0, 2.0), "ctrl_cost_weight": 0.5, "frame_skip": 2}),
    ("Walker2d-v4", {**UNHEALTHY, "healthy_z_range": (1.2, 1.25), "ctrl_cost_weight": 1}),
    ("Walker2d-v5", {**WITH_POSITIONS, "healthy_reward": -0.5, "healthy_angle_range": (-0.02, 0.02)}),
    ("Ant-v4", {"use_contact_forces": True, "contact_cost_weight": 0.1, "contact_force_range": (-2, 3)}),
    ("Ant-v4", {**WITH_POSITIONS, **UNHEALTHY, "healthy_z_range": (0.6, 0.7)}),
    ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0}),
    ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.2, "main_body": "aux_1"}),
    (
        "Ant-v5",
        {**WITH_POSITIONS, **UNHEALTHY, "main_body": 4, "frame_skip": 2, "healthy_z_range": (0.6, 0.7)},
    ),
    ("Humanoid-v4", {**WITH_POSITIONS, **UNHEALTHY, "healthy_z_range": (1.38, 1.4), "ctrl_cost_weight": 0.3}),
    ("Humanoid-v5", {**NOTHING_INCLUDED, "contact_cost_weight": 0.001, "contact_cost_range": (0.1, 2.0)}),
    ("Humanoid-v5", {"include_cvel_in_observation": False, "include_cinert_in_observation": 1, **UNHEALTHY}),
    ("Humanoid-v5", {**NOTHING_INCLUDED, "contact_cost_weight": 0, "contact_cost_range": (0.5, 2.0)}),
    ("HumanoidStandup-v5", {"include_cfrc_ext_in_observation": False, "impact_cost_weight": 0}),
    ("HumanoidStandup-v5", {**WITH_POSITIONS, "impact_cost_weight": 0.01, "impact_cost_range": (0.0, 1.0)}),
    (
        "HumanoidStandup-v5",
        {**NOTHING_INCLUDED, "uph_cost_weight": 2, "ctrl_cost_weight": 0.2, "frame_skip": 2},
    ),
    ("InvertedPendulum-v5", {"frame_skip": 4, "reset_noise_scale": 0.15}),
    ("InvertedDoublePendulum-v5", {"healthy_reward": 3, "frame_skip": 2, "reset_noise_scale": 0.3}),
    ("Reacher-v5", {"reward_dist_weight": 2.5, "reward_control_weight": 0.3, "frame_skip": 3}),
    ("Pusher-v5", {"reward_near_weight": 2, "reward_dist_weight": 0.3, "reward_control_weight": 3}),
]
CASES = [(env_id, {}) for env_id in CONSTRUCTIBLE] + VARIATIONS

STEPS = 6


def assert_bitwise(ours: object, theirs: object) -> None:
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs)
    assert ours.tobytes() == theirs.tobytes()


def test_every_registered_class_has_a_family() -> None:
    registered = set()
    for env_id in CONSTRUCTIBLE:
        module, name = gym.registry[env_id].entry_point.split(":")
        registered.add((module, name))
    assert len(registered) == len(CONSTRUCTIBLE) == 21
    assert registered <= {(kind.__module__, kind.__name__) for kind in known_families()}


@pytest.mark.parametrize(
    ("env_id", "kwargs"), CASES, ids=lambda value: value if isinstance(value, str) else ""
)
def test_transitions_are_bitwise_equal(env_id: str, kwargs: dict) -> None:
    """Rows follow the real environment from a reset, from mid-episode and beyond a termination."""
    env = SnapshotEnvWrapper(gym.make(env_id, **kwargs))
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=2)
    rng = np.random.default_rng(1)
    low, high = env.action_space.low, env.action_space.high
    env.reset(seed=3)
    for already_taken in (0, 11, 17):
        for _ in range(already_taken):
            env.step(rng.uniform(low, high).astype(np.float32))
        model.set_roots(model.read_roots([0]), np.zeros(5, dtype=int), rng)
        for _ in range(STEPS):
            actions = rng.uniform(low, high, size=(5, *low.shape)).astype(np.float32)
            actions[1], actions[3] = low, high
            # The first and the last row do what the real environment does, those between do not.
            actions[4] = actions[0]
            transition = model.step(actions)
            observation, reward, terminated, _, _ = env.step(actions[0])
            for row in (0, 4):
                assert_bitwise(transition.observations[row], observation)
                assert_bitwise(transition.rewards[row], np.float64(reward))
                assert transition.terminated[row] == terminated
            assert transition.observations[1].tobytes() != observation.tobytes()
            assert transition.valid.all()
    model.close()
    env.close()


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("Hopper-v5", {}),
        ("InvertedPendulum-v5", {}),
        ("InvertedDoublePendulum-v4", {}),
        ("Ant-v5", {"healthy_z_range": (0.65, 1.0)}),
    ],
)
def test_terminations_are_seen_at_the_same_step(env_id: str, kwargs: dict) -> None:
    env = SnapshotEnvWrapper(gym.make(env_id, **kwargs))
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    env.reset(seed=0)
    model.set_roots(model.read_roots([0]), np.zeros(1, dtype=int), np.random.default_rng())
    ends = []
    for _ in range(400):
        transition = model.step(env.action_space.high[None])
        _, _, terminated, _, _ = env.step(env.action_space.high)
        assert transition.terminated[0] == terminated
        ends.append(terminated)
        if terminated:
            break
    assert ends[-1]


@pytest.mark.parametrize("env_id", ["HumanoidStandup-v4", "HumanoidStandup-v5", "Humanoid-v5"])
def test_costs_of_a_violent_impact_are_limited(env_id: str) -> None:
    env = SnapshotEnvWrapper(gym.make(env_id))
    env.reset(seed=0)
    base = env.unwrapped
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    velocity = np.zeros(base.model.nv)
    velocity[2] = -100
    base.set_state(base.data.qpos.copy(), velocity)
    action, impacts = np.zeros(17, dtype=np.float32), []
    for _ in range(6):
        model.set_roots(model.read_roots([0]), np.zeros(1, dtype=int), np.random.default_rng())
        transition = model.step(action[None])
        observation, reward, *_ = env.step(action)
        assert_bitwise(transition.observations[0], observation)
        assert_bitwise(transition.rewards[0], reward)
        impacts.append(5e-7 * np.square(base.data.cfrc_ext).sum())
    assert max(impacts) > 10, "or the limit is not reached"


def test_the_rows_sizes_do_not_change_the_numbers() -> None:
    """Vectorised sums must not depend on how many rows there are, nor on the threads."""
    env = SnapshotEnvWrapper(gym.make("Humanoid-v5"))
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, size=(40, 17)).astype(np.float32)
    results = []
    for n_threads, rows in ((1, 40), (3, 40), (2, 7), (1, 1)):
        model = MujocoBatchModel(LocalEnvironments([env]), n_threads=n_threads)
        model.set_roots(model.read_roots([0]), np.zeros(rows, dtype=int), np.random.default_rng())
        results.append((model.step(actions[:rows]), model.step(actions[:rows])))
        model.close()
    for other in results[1:]:
        for ours, theirs in zip(other, results[0], strict=True):
            assert_bitwise(ours.observations, theirs.observations[: len(ours.observations)])
            assert_bitwise(ours.rewards, theirs.rewards[: len(ours.rewards)])


@pytest.mark.parametrize("exponent", [2, 3])
def test_powers_are_those_of_scalars(exponent: int) -> None:
    values = np.random.default_rng(0).normal(size=20000)
    assert_bitwise([scalar_power(value, exponent) for value in values], [value**exponent for value in values])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1, 6, 7, 8, 9, 16, 17, 84, 127, 128, 129, 300])
def test_sums_add_in_the_order_of_numpy(size: int, dtype: type) -> None:
    for values in np.random.default_rng(size).normal(size=(50, size)).astype(dtype):
        assert_bitwise(dtype(numpy_sum(values)), values.sum())
        assert_bitwise(dtype(sum_of_squares(values)), np.sum(np.square(values)))


def test_norms_round_as_numpys() -> None:
    for vector in np.random.default_rng(0).normal(size=(2000, 3)):
        assert norm(vector) == np.linalg.norm(vector)


@pytest.mark.skipif(JIT_IS_OFF, reason="is about compiled functions")
def test_norms_of_other_processors_are_compiled_anew() -> None:
    kept = {fingerprint(each) for each in (row_arithmetic._fused_norm, row_arithmetic._rounded_norm)}
    assert len(kept) == 2
    found = [
        [each(vector) for vector in np.random.default_rng(0).normal(size=(200, 3))]
        for each in (row_arithmetic._fused_norm, row_arithmetic._rounded_norm)
    ]
    np.testing.assert_allclose(*found, rtol=1e-15)
    assert row_arithmetic.norm in (row_arithmetic._fused_norm, row_arithmetic._rounded_norm)


@pytest.mark.parametrize("weight", [0.1, np.float64(0.1), np.float32(0.1), 3])
def test_weights_widen_as_in_numpy(weight: object) -> None:
    for values in np.random.default_rng(0).normal(size=(200, 6)).astype(np.float32):
        expected = np.float64(weight * np.sum(np.square(values)))
        assert weighted_squares(weight, widens(weight), values) == expected


def test_float64_actions_reach_the_simulator_as_they_are() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    model.set_roots(model.read_roots([0]), np.zeros(2, dtype=int), np.random.default_rng())
    actions = np.random.default_rng(0).uniform(-1, 1, size=(2, 6))
    transition = model.step(actions)
    observation, reward, *_ = env.step(actions[1])
    assert_bitwise(transition.observations[1], observation)
    assert_bitwise(transition.rewards[1], np.float64(reward))


def test_the_documented_family_is_taken_and_exact(capsys: pytest.CaptureFixture) -> None:
    tutorial = DOCUMENT.with_name("fast_path.md").read_text()
    blocks = re.findall(r"```python\n# example: family\n(.*?)```", tutorial, flags=re.DOTALL)
    assert len(blocks) == 3
    names: dict = {"__name__": "documented_example"}
    exec("\n".join(blocks), names)
    assert "MuJoCo batch of CartToGoal" in capsys.readouterr().out
    env, model = names["env"], names["model"]
    env.reset(seed=0)
    model.set_roots(model.read_roots([0]), np.zeros(1, dtype=int), np.random.default_rng())
    for step in range(40):
        action = np.array([3 * np.sin(step / 8)], dtype=np.float32)
        transition = model.step(action[None])
        observation, reward, terminated, _, _ = env.step(action)
        assert_bitwise(transition.observations[0], observation)
        assert_bitwise(transition.rewards[0], reward)
        assert transition.terminated[0] == terminated
        if terminated:
            break
    assert terminated


MOTOR_WITH_FILTER = """
<mujoco>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/>
      <site name="tip"/>
    </body>
  </worldbody>
  <actuator>
    <general joint="slider" dyntype="filter" dynprm="0.05" gainprm="20" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
  <sensor><velocimeter site="tip"/></sensor>
</mujoco>
"""


class FilteredMotor(MujocoEnv):
    """Observes the state of its actuator and a sensor."""

    metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, xml_file: str) -> None:
        super().__init__(xml_file, 2, gym.spaces.Box(-np.inf, np.inf, (4,), np.float64))

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self._observe(), self.data.qvel[0], False, False, {}

    def reset_model(self):
        self.set_state(self.np_random.uniform(-0.1, 0.1, 1), self.init_qvel)
        return self._observe()

    def _observe(self):
        return np.concatenate([self.data.act, self.data.sensordata])


def test_families_may_read_actuator_states_and_sensors(tmp_path: Path, monkeypatch) -> None:
    def transition(env, kept, data, action, observation):
        observation[:1], observation[1:] = data.act, data.sensordata
        return data.qvel[0], False

    (tmp_path / "motor.xml").write_text(MOTOR_WITH_FILTER)
    monkeypatch.setattr(families, "_FAMILIES", dict(families._FAMILIES))
    register_family(FilteredMotor, Family(lambda env: {}, ("qvel", "act", "sensordata"), transition))
    env = SnapshotEnvWrapper(FilteredMotor(str(tmp_path / "motor.xml")))
    env.reset(seed=0)
    model = make_forward_model(LocalEnvironments([env]), "mujoco")
    model.set_roots(model.read_roots([0]), np.zeros(1, dtype=int), np.random.default_rng())
    for action in np.float32([[1.0], [-0.5], [0.25]]):
        transition_of_model = model.step(action[None])
        observation, reward, *_ = env.step(action)
        assert_bitwise(transition_of_model.observations[0], observation)
        assert_bitwise(transition_of_model.rewards[0], reward)


def test_the_documented_introduction_runs(capsys: pytest.CaptureFixture) -> None:
    introduction = re.search(r"```python\n(import gymnasium.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
    assert introduction is not None
    names: dict = {}
    exec(introduction[1], names)
    assert capsys.readouterr().out.startswith("MuJoCo batch of HalfCheetahEnv (compiled, ")
    assert names["second"].valid.all()


def test_wrong_registrations_are_refused() -> None:
    family = Family(lambda env: {}, ("qpos",), lambda env, kept, data, action, observation: (0.0, False))
    with pytest.raises(TypeError, match="subclass of gymnasium's MujocoEnv"):
        register_family(gym.Env, family)
    with pytest.raises(TypeError, match="wants a Family for AntEnv"):
        register_family(AntEnv, lambda: None)


def _stays(env, kept, data, action, observation):
    observation[:] = 0.0
    return 0.0, False


def _writes_too_far(env, kept, data, action, observation):
    observation[4] = 1.0
    return 0.0, False


def _is_only_python(env, kept, data, action, observation):
    observation[:] = sorted(data.qpos, key=str)[0]
    return 0.0, False


@pytest.mark.parametrize(
    ("constants", "fields", "transition", "message"),
    [
        (lambda env: {"goal": env._nowhere}, ("qpos",), _stays, "does not have: .*'_nowhere'"),
        (lambda env: {"goal": "left"}, ("qpos",), _stays, "the constant 'goal' is a str"),
        (lambda env: {}, ("qposs",), _stays, "'qposs' is not an array of MjData"),
        (lambda env: {}, ("qpos",), _stays, "the observation of the model and of the environment differ"),
        (lambda env: {}, ("qpos",), _writes_too_far, "the family of Cart failed with IndexError"),
        (lambda env: {}, ("qpos",), _is_only_python, "the family of Cart failed with TypingError"),
    ],
)
def test_mistakes_in_a_family_are_explained(constants, fields, transition, message: str) -> None:
    class Cart(InvertedPendulumEnv):
        """An environment that is no known one."""

    register_family(Cart, Family(constants, fields, transition))
    with pytest.raises(ForwardModelError, match=message):
        MujocoBatchModel(LocalEnvironments([SnapshotEnvWrapper(Cart())]), n_threads=1)
