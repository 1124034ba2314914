"""Draws one decision of a search, docs/images/decision.png: ``python docs/images/decision.py``."""

from pathlib import Path

import gymnasium as gym
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_mcbs import SnapshotEnvWrapper

WIDTH, DEPTH, NOISE, GAMMA = 18, 12, 0.4, 0.99


def angle_of(env: gym.Env) -> float:
    return float(np.rad2deg(env.unwrapped.state[0]))


def roll_out(env: SnapshotEnvWrapper, model: SAC, action: np.ndarray) -> tuple[list[float], float]:
    """Angles and value of a candidate."""
    angles, value = [angle_of(env)], 0.0
    for depth in range(DEPTH):
        observation, reward, *_ = env.step(action)
        angles.append(angle_of(env))
        value += GAMMA**depth * float(reward)
        action, _ = model.predict(observation, deterministic=True)
    with th.no_grad():
        scaled = model.policy.scale_action(action)
        critics = model.critic(th.as_tensor(observation)[None], th.as_tensor(scaled)[None])
    return angles, value + GAMMA**DEPTH * float(th.min(th.cat(critics)))


def main() -> None:
    model = SAC("MlpPolicy", "Pendulum-v1", learning_rate=1e-3, seed=0, device="cpu").learn(3_500)
    env, rng = SnapshotEnvWrapper(gym.make("Pendulum-v1")), np.random.default_rng(0)
    observation, _ = env.reset(seed=3)
    past = [angle_of(env)]
    for _ in range(22):
        action, _ = model.predict(observation, deterministic=True)
        observation, *_ = env.step(action)
        past.append(angle_of(env))

    now = env.snapshot()
    action, _ = model.predict(observation, deterministic=True)
    candidates = np.clip(action / 2 + rng.normal(0, NOISE, (WIDTH, 1)), -1, 1).astype(np.float32) * 2
    rollouts = []
    for candidate in candidates:
        env.restore(now)
        rollouts.append(roll_out(env, model, candidate))
    values = np.array([value for _, value in rollouts])

    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    colours = matplotlib.colormaps["cividis_r"]
    scale = matplotlib.colors.Normalize(values.min(), values.max())
    axes.plot(range(-len(past) + 1, 1), past, color="black", linewidth=2)
    for index in np.argsort(values):
        chosen = index == values.argmax()
        axes.plot(rollouts[index][0], color=colours(scale(values[index])), linewidth=4 if chosen else 1.2)
    axes.plot(0, past[-1], "o", color="black")
    axes.annotate("now", (0, past[-1]), (-8, 10), textcoords="offset points", ha="right")
    axes.annotate("executed", (DEPTH, rollouts[values.argmax()][0][-1]), (6, 0), textcoords="offset points", va="center")
    axes.set(xlabel="environment steps from now", ylabel="angle of the pendulum (degrees)", xlim=(-14, DEPTH + 3))
    axes.set_ylim(min(past[-14:]) - 10, None)
    figure.colorbar(matplotlib.cm.ScalarMappable(scale, colours), ax=axes, label="value: rewards and critics")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    main()
