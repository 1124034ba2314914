"""Search with ONNX Runtime and MuJoCo alone, under a deadline: no torch, no Stable-Baselines3.

sb3-mcbs export agent.zip --env HalfCheetah-v5 -o policy.onnx
python onnx_search.py policy.onnx half_cheetah.xml 1000
"""

import sys
import time

import mujoco
import numpy as np
import onnxruntime

SKIP, DEPTH, NOISE, DEADLINE = 5, 3, 0.1, 0.01  # steps per action, look-ahead, candidates' spread, seconds
path, xml, steps = sys.argv[1], sys.argv[2], int(sys.argv[3])
actor = onnxruntime.InferenceSession(path)
critics = onnxruntime.InferenceSession(path.replace(".onnx", "-critics.onnx"))
about = actor.get_modelmeta().custom_metadata_map
gamma, scale = float(about["gamma"]), float(about["reward_scale"])
model = mujoco.MjModel.from_xml_path(xml)
data, copy, rng = mujoco.MjData(model), mujoco.MjData(model), np.random.default_rng(0)


def observe(state):  # this function and the next are HalfCheetah-v5
    return np.concatenate([state.qpos[1:], state.qvel])[None].astype(np.float32)


def step(state, action):
    before, state.ctrl[:] = state.qpos[0], action
    mujoco.mj_step(model, state, SKIP)
    return (state.qpos[0] - before) / (SKIP * model.opt.timestep) - 0.1 * np.square(action).sum()


def act(observation):
    return actor.run(["action"], {"observation": observation})[0][0]


def value_of(action):
    mujoco.mj_copyData(copy, model, data)
    total = 0.0
    for depth in range(DEPTH):
        total += gamma**depth * scale * step(copy, action)
        observation = observe(copy)
        action = act(observation)
    value = critics.run(["value"], {"observation": observation, "action": action[None]})[0][0]
    return total + gamma**DEPTH * value


def search(until):
    best = own = act(observe(data))
    value = value_of(own)
    while time.perf_counter() < until:
        candidate = np.clip(own + NOISE * rng.standard_normal(own.shape, np.float32), -1.0, 1.0)
        candidate_value = value_of(candidate)
        if candidate_value > value:
            best, value = candidate, candidate_value
    return best


total = sum(step(data, search(time.perf_counter() + DEADLINE)) for _ in range(steps))
print(f"return {total:.1f} in {steps} steps")
